"""Size, time and fidelity of each splat format: numbers for docs/formats.md.

python -P -m idesplat.tools.figures.compare_formats --gaussians 131072
"""

import time
from typing import Annotated

import numpy as np
import typer

from ...runtime.cli.terminal import run, say
from ...runtime.geometry.intrinsics import intrinsic_matrix
from ...runtime.rendering.render import render_view
from ...runtime.splats.gaussians import Gaussians
from ...runtime.splats.io import FORMATS, read_splats, write_splats
from ...runtime.system.files import scratch_folder
from ..evaluation.metrics import psnr

VIEWS = 2
SIDE = 256  # of the image
SH_SPREAD = (0.025, 0.006)  # standard deviation at degree 1 and 2: networks predict little view dependence


def example_scene(gaussians: int) -> Gaussians:
    """About as many Gaussians as asked for, one for each pixel of two depth maps, as a network predicts them."""
    side = round((gaussians / VIEWS) ** 0.5)
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:side, :side] / side
    means = []
    for view in range(VIEWS):
        z = 3 + np.sin(3 * x + view) + 0.5 * np.cos(5 * y) + rng.normal(0, 0.01, x.shape)
        z[side // 3 : side // 2, side // 3 : side // 2] -= 1
        means.append(np.stack([(x - 0.5) * z + 0.2 * view, (y - 0.5) * z, z], axis=-1).reshape(-1, 3))
    count = VIEWS * side**2
    sh = rng.normal(size=(count, 9, 3)) * np.repeat((0, *SH_SPREAD), (1, 3, 5))[:, None]
    pattern = np.stack([np.sin(9 * x + k) * np.cos(7 * y - k) for k in range(3)], axis=-1)
    sh[:, 0] = np.tile(pattern.reshape(-1, 3), (VIEWS, 1))
    arrays = {
        "means": np.concatenate(means),
        "scales": np.concatenate(means)[:, 2:] / side * np.exp(rng.normal(-0.3, 0.3, (count, 3))),
        "quats": rng.normal([1, 0, 0, 0], 0.3, (count, 4)),
        "opacities": rng.beta(2, 1, count),
        "sh": sh,
    }
    return Gaussians(**{name: values.astype(np.float32) for name, values in arrays.items()})


def compare(gaussians: Annotated[int, typer.Option(help="How many.", min=100)] = 131_072) -> None:
    """Print for each format CPU seconds to write and read, megabytes, and PSNR of a render after reading it back."""
    scene = example_scene(gaussians)
    rendered = _render(scene)
    say(f"{len(scene):,} Gaussians", f"{'format':16}{'write, s':>10}{'read, s':>10}{'MB':>8}{'PSNR, dB':>10}")
    with scratch_folder() as folder:
        for suffix in FORMATS:
            path = folder / f"scene{suffix}"
            started = time.process_time()
            write_splats(path, scene)
            written = time.process_time()
            back = read_splats(path)
            read = time.process_time()
            quality = psnr(_render(back), rendered, np.ones(rendered.shape[:2], bool))
            megabytes = path.stat().st_size / 1e6
            say(f"{suffix:16}{written - started:10.2f}{read - written:10.2f}{megabytes:8.1f}{quality:10.1f}")


def _render(scene: Gaussians) -> np.ndarray:
    """Render the scene from between the views."""
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 0.1
    K = intrinsic_matrix(SIDE, SIDE, SIDE / 2, SIDE / 2)
    return render_view(scene, extrinsics, K, SIDE, SIDE).rgb


def main() -> None:
    """Run the command."""
    run(compare)


if __name__ == "__main__":
    main()
