"""The finished scenes beside those of OpenSplat, a trainer of 3D Gaussian splatting that runs on a CPU.

    python -P -m idesplat.tools.evaluation.captures.peer opensplat --checkouts DIR

Both get the same views of a capture at the same size. OpenSplat starts from coloured points, as it does from those of
COLMAP: here they are the means of every POINT_STRIDE-th Gaussian that the network predicts, which are denser. Its
options are the defaults, but for the number of steps and the size of the images, which is the full one from the start.
"""

import json
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from ....runtime.cameras.formats import transforms
from ....runtime.cli.terminal import run, say
from ....runtime.errors import InputError
from ....runtime.images.png import save_png
from ....runtime.inference.bundled_model import bundled_model
from ....runtime.inference.predictor import Predictor
from ....runtime.reconstruction.quality import Quality
from ....runtime.reconstruction.steps import make_plan
from ....runtime.splats.filtering import FilterOptions
from ....runtime.splats.gaussians import Gaussians
from ....runtime.splats.io import read_splats
from ....runtime.splats.points import PointCloud, points_from_gaussians
from ....runtime.system.files import scratch_folder
from ..cases import EvalCase
from ..metrics import psnr, ssim
from ..novel_views import render_target
from ..report import print_table
from .capture import CaptureImages, read_captures
from .checkouts import frames_of
from .scores import CaptureEvaluator

SIZE = (256, 256)
POINT_STRIDE = 16
SCENE = "splat.ply"
POINTS = "points.ply"
SHOWN_LINES = 3  # of what OpenSplat printed before it failed


def compare(
    opensplat: Annotated[Path, typer.Argument(help="OpenSplat's executable.", show_default=False)],
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    capture: Annotated[list[str] | None, typer.Option(help="Use this capture alone; may be repeated.")] = None,
    views: Annotated[int, typer.Option(help="Number of input views.", min=3)] = 6,
    steps: Annotated[list[int] | None, typer.Option(help="Steps of OpenSplat; may be repeated.")] = None,
) -> None:
    """Measure PSNR and SSIM of held-out frames, and seconds, of the finished scenes and of OpenSplat's."""
    predictor = Predictor(bundled_model())
    plans = {
        str(quality): make_plan(quality, predictor.model, None, FilterOptions(), 0)
        for quality in (Quality.FAST, Quality.STANDARD)
    }
    table = Table()
    for heading in ("capture", "scene", "PSNR", "SSIM", "seconds"):
        table.add_column(heading, justify="left" if heading in ("capture", "scene") else "right")
    for source in read_captures(capture or ()):
        context, targets = source.window(views)
        if not context:
            continue
        with frames_of(checkouts, source) as images:
            case = CaptureImages(source, images, SIZE).case(context, targets, predictor.depth_range)
            ours = {name: CaptureEvaluator(predictor, {}, plan).predict(case) for name, plan in plans.items()}
        scenes = {name: (scene.gaussians, scene.seconds) for name, scene in ours.items()}
        predicted = ours[Quality.FAST].gaussians
        for count in steps or (plans[Quality.STANDARD].preset.steps(views),):
            scenes[f"OpenSplat, {count} steps"] = train_opensplat(opensplat, case, predicted, count)
        for name, (gaussians, seconds) in scenes.items():
            scores = _scores(gaussians, case)
            table.add_row(source.name, name, *scores, f"{seconds:.1f}")
            say(f"{source.name}, {name}: {' dB, SSIM '.join(scores)}, {seconds:.1f} s")
    print_table(table)


def train_opensplat(opensplat: Path, case: EvalCase, predicted: Gaussians, steps: int) -> tuple[Gaussians, float]:
    """OpenSplat's scene of the context views, and the seconds that it took.

    Raises InputError if OpenSplat fails.
    """
    with scratch_folder() as folder:
        write_project(folder, case, predicted)
        # One scale of the images, and the number of steps; poses stay as they are.
        options = ("--num-downscales", "0", "--num-iters", str(steps), "--keep-crs", "--output", str(folder / SCENE))
        started = time.perf_counter()
        done = subprocess.run([opensplat, folder, *options], capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - started
        if done.returncode:
            last = " ".join((done.stdout + done.stderr).splitlines()[-SHOWN_LINES:])
            raise InputError(f"{opensplat}: ended with {done.returncode}: {last}")
        return read_splats(folder / SCENE), seconds


def write_project(folder: Path, case: EvalCase, predicted: Gaussians) -> None:
    """Write the context views as a project of Nerfstudio: images, transforms.json and points.ply."""
    context = case.context
    cameras = [replace(camera, name=f"{view:03}.png") for view, camera in enumerate(context.cameras())]
    for view, camera in enumerate(cameras):
        save_png(folder / camera.name, context.image(view))
    _write_points(folder / POINTS, points_from_gaussians(predicted))
    path = folder / "transforms.json"
    transforms.write(path, cameras)
    content = json.loads(path.read_text()) | {"camera_model": "OPENCV", "ply_file_path": POINTS}
    path.write_text(json.dumps(content))


def _write_points(path: Path, cloud: PointCloud) -> None:
    """Write every POINT_STRIDE-th point as text: OpenSplat's reader does not know the alpha that trimesh adds."""
    rows = np.column_stack([cloud.positions, cloud.colours])[::POINT_STRIDE]
    properties = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    np.savetxt(path, rows, "%.9g %.9g %.9g %d %d %d", header="\n".join(header), comments="")


def _scores(gaussians: Gaussians, case: EvalCase) -> tuple[str, str]:
    """Mean PSNR and SSIM over the held-out frames."""
    values = []
    for index in range(len(case.targets)):
        image = render_target(gaussians, case.targets, index).rgb
        truth, valid = case.targets.image(index), case.targets.valid[index]
        values.append((psnr(image, truth, valid), ssim(image, truth, valid)))
    means = np.mean(values, axis=0)
    return f"{means[0]:.2f}", f"{means[1]:.3f}"


def main() -> None:
    """Run the command."""
    run(compare)


if __name__ == "__main__":
    main()
