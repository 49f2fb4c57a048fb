"""The rasteriser and .ply files, timed beside other implementations: numbers for docs/performance.md.

python -P -m idesplat.tools.benchmark.components

gsplat's torch reference projects and colours on a CPU, but composites with CUDA alone: that step is ours, in torch as
well, with every fragment of the image at once, sorted by pixel and depth.
"""

import math
import sys
import tempfile
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...runtime.cli.terminal import run
from ...runtime.inference.session import usable_cores
from .runner import SETTLE_SECONDS, thread_environment
from .worker import Prepared, Worker

if TYPE_CHECKING:
    from torch import Tensor

    from ...runtime.splats.gaussians import Gaussians

SIDE = 256
FOCAL = 0.9 * SIDE
DRAWN_SPLATS = 2 * SIDE * SIDE
FILE_SPLATS = 500_000
PLY_COLUMNS = 41  # of SH degree 2, with normals

Candidates = dict[str, tuple[Any, ...]]


def main(
    repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 9,
    threads: Annotated[int | None, typer.Option(help="torch's threads, instead of one a core.", min=1)] = None,
) -> None:
    """Time the rasteriser and .ply files."""
    threads = threads or usable_cores()
    rasterizers: Candidates = {"NumPy": (rasterizer, False)}
    if find_spec("numba"):
        rasterizers["compiled (numba)"] = (rasterizer, True)
    if find_spec("torch") and find_spec("gsplat"):
        rasterizers = {"torch, gsplat's reference": (torch_rasterizer, threads), **rasterizers}
    with thread_environment(threads), tempfile.TemporaryDirectory() as folder:
        run_interleaved(f"{DRAWN_SPLATS:,} splats a pixel wide at {SIDE}x{SIDE}", rasterizers, repeats)
        run_interleaved(f"writing {FILE_SPLATS:,} splats, SH degree 2", _files(Path(folder), "write"), repeats)
        run_interleaved(f"reading {FILE_SPLATS:,} splats, SH degree 2", _files(Path(folder), "read"), repeats)


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
    table.add_column("")
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
    """Ours, compiled or not; the first run includes what has to be compiled or loaded."""
    if not compiled:
        sys.modules["numba"] = None  # type: ignore[assignment]  # as if it were not installed
    from ...runtime.rendering.rasterizer import rasterize

    splats, K = pixel_sized_splats(DRAWN_SPLATS), pinhole()

    def run() -> None:
        rasterize(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, np.eye(4), K, SIDE, SIDE)

    return None, run


def torch_rasterizer(threads: int) -> Prepared:
    """gsplat's torch projection and colours, and compositing in torch."""
    import torch

    torch.set_num_threads(threads)
    splats = pixel_sized_splats(DRAWN_SPLATS)
    arrays = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh, np.eye(4), pinhole())
    tensors = [torch.from_numpy(np.asarray(array, np.float32)) for array in arrays]

    def run() -> None:
        with torch.inference_mode():
            torch_rasterize(*tensors)

    return None, run


def pixel_sized_splats(count: int) -> "Gaussians":
    """Splats about as wide as a pixel of a camera at the origin, two at each pixel, as networks predict them."""
    from ...runtime.splats.gaussians import Gaussians

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
    """Its camera's K, [3, 3]."""
    return np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])


def torch_rasterize(
    means: "Tensor",
    quats: "Tensor",
    scales: "Tensor",
    opacities: "Tensor",
    sh: "Tensor",
    viewmat: "Tensor",
    K: "Tensor",
) -> "Tensor":
    """Red, green, blue, depth and alpha, [SIDE, SIDE, 5], of Gaussians that the camera sees."""
    import torch
    from gsplat.cuda import _torch_impl as reference

    covariances, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, centres, depth, conics, _ = reference._fully_fused_projection(
        means, covariances, viewmat[None], K[None], SIDE, SIDE
    )
    directions = means - torch.linalg.inv(viewmat)[:3, 3]
    colours = torch.clamp_min(reference._spherical_harmonics(math.isqrt(sh.shape[1]) - 1, directions, sh) + 0.5, 0)
    order = torch.argsort(depth[0])
    order = order[(radii[0][order] > 0).all(dim=-1)]
    paint = torch.cat([colours, depth[0][:, None], torch.ones(len(means), 1)], dim=1)
    return _composite(centres[0][order], conics[0][order], opacities[order], paint[order])


def _composite(centres: "Tensor", conics: "Tensor", opacities: "Tensor", paint: "Tensor") -> "Tensor":
    """Blend splats, the nearest first: every fragment at once, sorted by pixel."""
    import torch

    reach = 2 * torch.log(opacities * 255).clamp_min(0)
    determinant = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
    half = torch.sqrt(reach[:, None] * conics[:, [2, 0]] / determinant[:, None])
    first = torch.ceil(centres - half - 0.5).clamp(0, SIDE).long()
    size = ((torch.floor(centres + half - 0.5) + 1).clamp(0, SIDE).long() - first).clamp_min(0)
    counts = size.prod(dim=1)
    splat = torch.repeat_interleave(torch.arange(len(counts)), counts)
    place = torch.arange(len(splat)) - (torch.cumsum(counts, 0) - counts)[splat]
    columns = size[splat, 0]
    column, row = first[splat, 0] + place % columns, first[splat, 1] + place // columns
    dx, dy = column + 0.5 - centres[splat, 0], row + 0.5 - centres[splat, 1]
    xx, xy, yy = conics[splat].unbind(-1)
    alpha = torch.clamp_max(opacities[splat] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy), 0.99)
    drawn = alpha >= 1 / 255
    alpha, splat, pixel = alpha[drawn], splat[drawn], (row * SIDE + column)[drawn]
    by_pixel = torch.argsort(pixel, stable=True)
    alpha, splat, pixel = alpha[by_pixel], splat[by_pixel], pixel[by_pixel]
    passed = torch.log1p(-alpha).double()
    running = torch.cumsum(passed, 0)
    ends = torch.cumsum(torch.bincount(pixel, minlength=SIDE * SIDE), 0)
    before = torch.cat([torch.zeros(1, dtype=torch.double), running])[torch.cat([torch.zeros(1).long(), ends[:-1]])]
    running -= before[pixel]
    weight = torch.where(running > math.log(1e-4), alpha * torch.exp(running - passed).float(), torch.zeros(()))
    return torch.zeros(SIDE * SIDE, 5).index_add_(0, pixel, weight[:, None] * paint[splat]).view(SIDE, SIDE, 5)


# ---- files


def _files(folder: Path, verb: str) -> Candidates:
    """Ours beside the same bytes written or read with NumPy alone."""
    return {"NumPy, the same bytes": (plain_file, folder, verb), "ours": (ply_file, folder, verb)}


def plain_file(folder: Path, verb: str) -> Prepared:
    """Bytes without a meaning: what the disk and the memory take."""
    path, table = folder / "plain.bin", np.random.default_rng(0).random((FILE_SPLATS, PLY_COLUMNS), np.float32)

    def write() -> None:
        table.tofile(path)

    def read() -> None:
        np.fromfile(path, np.float32)

    write()
    return None, {"write": write, "read": read}[verb]


def ply_file(folder: Path, verb: str) -> Prepared:
    """Our .ply files."""
    from ...runtime.splats.formats.ply import read_ply, write_ply

    path, splats = folder / "ours.ply", pixel_sized_splats(FILE_SPLATS)

    def write() -> None:
        write_ply(path, splats)

    def read() -> None:
        read_ply(path)

    write()
    return None, {"write": write, "read": read}[verb]


if __name__ == "__main__":
    run(main)
