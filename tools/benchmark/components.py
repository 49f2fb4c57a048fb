"""The rasteriser and .ply files, timed beside other implementations: numbers for docs/performance.md.

python -P -m idesplat.tools.benchmark.components
"""

import sys
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...runtime.cli.terminal import run
from ...runtime.geometry.intrinsics import intrinsic_matrix
from ...runtime.inference.session import usable_cores
from ...runtime.refinement.options import RefinementOptions
from ...runtime.refinement.refine import Optimiser, PosedImage
from ...runtime.rendering import rasterizer as rasterizer_module
from ...runtime.rendering import rasterizer_numpy
from ...runtime.rendering.rasterizer import rasterize
from ...runtime.splats.formats.ply import read_ply, write_ply
from ...runtime.splats.gaussians import Gaussians
from ...runtime.system.files import scratch_folder
from .runner import SETTLE_SECONDS, thread_environment
from .worker import Prepared, Worker

SIDE = 256
FOCAL = 0.9 * SIDE
RENDERED_SPLATS = 2 * SIDE * SIDE
FILE_SPLATS = 500_000
PLY_COLUMNS = 41  # of SH degree 2, with normals

Candidates = dict[str, tuple[Any, ...]]


def main(repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 9) -> None:
    """Time the rasteriser, refinement and .ply files."""
    rasterizers: Candidates = {"NumPy": (rasterizer, False), "compiled (numba)": (rasterizer, True)}
    with thread_environment(usable_cores()), scratch_folder() as folder:
        run_interleaved(f"{RENDERED_SPLATS:,} splats a pixel wide at {SIDE}x{SIDE}", rasterizers, repeats)
        if find_spec("torch"):
            steps: Candidates = {"PyTorch": (torch_refinement,), "compiled (numba)": (refinement,)}
            run_interleaved(f"a step of refinement, {RENDERED_SPLATS:,} splats at {SIDE}x{SIDE}, L1", steps, repeats)
        run_interleaved(f"writing {FILE_SPLATS:,} splats, SH degree 2", _files(folder, "write"), repeats)
        run_interleaved(f"reading {FILE_SPLATS:,} splats, SH degree 2", _files(folder, "read"), repeats)


def run_interleaved(title: str, candidates: Candidates, repeats: int) -> None:
    """Run the candidates interleaved, round by round; print medians, and ratios to the first one's."""
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    first_seconds = {}
    with ExitStack() as stack, Console(stderr=True).status(title):
        workers = {name: stack.enter_context(Worker(*candidate)) for name, candidate in candidates.items()}
        for name, worker in workers.items():
            first_seconds[name] = worker.run().seconds
        for _ in range(repeats):
            for name, worker in workers.items():
                time.sleep(SETTLE_SECONDS)
                seconds[name].append(worker.run().seconds)
    table = Table(title=title, title_justify="left")
    table.add_column("candidate")
    for column in ("first run", "later, median", "spread", "ratio"):
        table.add_column(column, justify="right")
    base = next(iter(seconds.values()))
    for name, values in seconds.items():
        low, median, high = np.percentile(values, (25, 50, 75))
        ratio = float(np.median(np.divide(values, base)))
        table.add_row(
            name, f"{first_seconds[name]:.3f}", f"{median:.3f}", f"{(high - low) / median:.0%}", f"{ratio:.3f}"
        )
    Console(width=None if sys.stdout.isatty() else 100).print(table)


# ---- rasterisers


def rasterizer(compiled: bool) -> Prepared:
    """Our rasteriser, compiled or not; the first run includes compiling and loading."""
    if not compiled:
        rasterizer_module._kernels = lambda: rasterizer_numpy  # type: ignore[assignment]
    splats, K = pixel_sized_splats(RENDERED_SPLATS), pinhole()

    def run() -> None:
        rasterize(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, np.eye(4), K, SIDE, SIDE)

    return None, run


def pixel_sized_splats(count: int) -> "Gaussians":
    """Splats about a pixel wide in a camera at the origin, two at each pixel, as networks predict them."""
    rng = np.random.default_rng(0)
    rows, columns = np.divmod(np.arange(count) % (SIDE * SIDE), SIDE)
    z = rng.uniform(1.5, 3, count)
    middle = SIDE / 2 - 0.5
    fields = (
        np.stack([(columns - middle) / FOCAL * z, (rows - middle) / FOCAL * z, z], axis=1),
        (z / FOCAL)[:, None] * rng.uniform(0.3, 1, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.05, 0.95, count),
        rng.normal(size=(count, 9, 3)) * 0.2,
    )
    return Gaussians(*(np.ascontiguousarray(field, np.float32) for field in fields))


def pinhole() -> np.ndarray:
    """K of the camera of `pixel_sized_splats`, in pixels, [3, 3]."""
    return intrinsic_matrix(FOCAL, FOCAL, SIDE / 2, SIDE / 2)


# ---- refinement


def refinement() -> Prepared:
    """A step of `runtime.refinement`."""
    image = np.full((SIDE, SIDE, 3), 0.5, np.float32)
    view = PosedImage(image, np.eye(4), pinhole(), np.ones((SIDE, SIDE), bool))
    optimiser = Optimiser(pixel_sized_splats(RENDERED_SPLATS), [view], RefinementOptions(ssim_weight=0))

    def run() -> None:
        optimiser.step(0, 1.0)

    return None, run


def torch_refinement() -> Prepared:
    """The same step with the differentiable rasteriser of training and PyTorch's Adam."""
    import torch

    from ..training.rasterizer import rasterize as torch_rasterize

    splats = pixel_sized_splats(RENDERED_SPLATS)
    parts = (splats.means, splats.quats, np.log(splats.scales), splats.opacities, splats.sh)
    means, quats, log_scales, opacities, sh = parameters = [torch.from_numpy(part).requires_grad_() for part in parts]
    adam = torch.optim.Adam(parameters, lr=1e-4)
    target, K = torch.full((SIDE, SIDE, 3), 0.5), torch.from_numpy(pinhole()).float()
    camera = torch.eye(4), K, SIDE, SIDE, torch.zeros(3)

    def run() -> None:
        adam.zero_grad()
        rgb, _, _ = torch_rasterize(means, quats, log_scales.exp(), opacities.clamp(1e-3, 0.999), sh, *camera)
        (rgb - target).abs().mean().backward()
        adam.step()

    return None, run


# ---- files


def _files(folder: Path, verb: str) -> Candidates:
    """Our .ply files beside the same number of bytes written or read with NumPy alone."""
    return {"NumPy, the same bytes": (plain_file, folder, verb), "ours": (ply_file, folder, verb)}


def plain_file(folder: Path, verb: str) -> Prepared:
    """A plain file of the same size as the .ply file, to time disk and memory alone."""
    path, table = folder / "plain.bin", np.random.default_rng(0).random((FILE_SPLATS, PLY_COLUMNS), np.float32)

    def write() -> None:
        table.tofile(path)

    def read() -> None:
        np.fromfile(path, np.float32)

    write()
    return None, {"write": write, "read": read}[verb]


def ply_file(folder: Path, verb: str) -> Prepared:
    """Our .ply files."""
    path, splats = folder / "ours.ply", pixel_sized_splats(FILE_SPLATS)

    def write() -> None:
        write_ply(path, splats)

    def read() -> None:
        read_ply(path)

    write()
    return None, {"write": write, "read": read}[verb]


if __name__ == "__main__":
    run(main)
