"""How well the cameras of few photographs are estimated: frames in a row of the validation captures.

    python -P -m idesplat.tools.evaluation.captures.estimated_cameras --checkouts DIR [--focal-error 0]

The reference are the cameras in `captures.json`, which were found from all images. As usual for relative poses, the
error of a pair of images is the larger one of the angle between the relative rotations and that between the directions
of translation, AUC@t the area under the curve of the share of pairs with less error, up to t degrees; pairs with an
image that is not registered count with the largest error.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image
from rich.table import Table

from ....runtime.cameras.camera import Camera
from ....runtime.cli.terminal import run
from ....runtime.errors import InputError
from ....runtime.geometry.rigid import invert_rigid
from ....runtime.images.exif import EXIF_DIRECTORY, FILM_DIAGONAL_MM, FOCAL_LENGTH_35MM
from ....runtime.sfm.estimate import estimate_cameras
from ....runtime.system.files import scratch_folder
from ....runtime.system.progress import progress
from ..report import print_table
from .capture import Capture, load_shrunk, read_captures
from .checkouts import frames_of

IMAGES = (3, 4, 6, 8)  # in a row
WINDOWS = 3  # of each capture and number of images, spread over the frames
SIDE = 1600  # pixels: longer side of the images
JPEG_QUALITY = 95
AUC_DEGREES = (5, 20)
MAX_ERROR = 180.0


@dataclass(frozen=True)
class Estimate:
    """The estimate of a window. errors: of all pairs of images, degrees. focals: found over true focal lengths."""

    images: int
    registered: int
    errors: list[float]
    focals: list[float]
    seconds: float


def estimate_windows(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    capture: Annotated[list[str] | None, typer.Option(help="Use this capture alone; may be repeated.")] = None,
    focal_error: Annotated[
        float | None, typer.Option(help="Percent by which the EXIF data are wrong; by default there are none.")
    ] = None,
) -> None:
    """Estimate the cameras of few frames in a row, and compare them with those of all."""
    factor = None if focal_error is None else 1 + focal_error / 100
    found: list[Estimate] = []
    for source in progress(read_captures(capture or ()), "estimating cameras"):
        with scratch_folder() as folder:
            cameras = _write(source, checkouts, folder, factor)
            for count in (count for count in IMAGES if count <= len(cameras)):
                starts = np.unique(np.linspace(0, len(cameras) - count, WINDOWS).astype(int))
                found += [_estimate(cameras[start : start + count], folder) for start in starts]
    table = Table()
    aucs = [f"AUC@{degrees}" for degrees in AUC_DEGREES]
    for heading in ("images", "windows", "registered", "all", "under 3", *aucs, "focal length", "seconds"):
        table.add_column(heading, justify="right")
    for count in sorted({estimate.images for estimate in found}):
        table.add_row(*_row(str(count), [estimate for estimate in found if estimate.images == count]))
    table.add_row(*_row("all", found))
    print_table(table)


def _write(capture: Capture, checkouts: Path, folder: Path, factor: float | None) -> list[Camera]:
    """Write the frames, with focal lengths times `factor` in their EXIF data unless it is None; their cameras."""
    cameras = []
    with frames_of(checkouts, capture) as source:
        for name in capture.frames:
            image, camera = load_shrunk(capture, source, name, SIDE)
            exif = Image.Exif()
            if factor is not None:
                diagonal = np.hypot(camera.width, camera.height)
                film = round(factor * camera.K[0, 0] / diagonal * FILM_DIAGONAL_MM)
                exif.get_ifd(EXIF_DIRECTORY)[FOCAL_LENGTH_35MM] = film
            Image.fromarray(image).save(_path(folder, camera), quality=JPEG_QUALITY, exif=exif)
            cameras.append(camera)
    return cameras


def _path(folder: Path, camera: Camera) -> Path:
    return folder / f"{Path(camera.name).stem}.jpg"


def _estimate(known: Sequence[Camera], folder: Path) -> Estimate:
    """The estimate of the images of these cameras."""
    started = time.perf_counter()
    try:
        cameras = estimate_cameras([_path(folder, camera) for camera in known])
    except InputError:
        cameras = []
    seconds = time.perf_counter() - started
    found = {Path(camera.name): camera for camera in cameras}
    pairs = [(camera, found.get(_path(folder, camera))) for camera in known]
    errors = [pose_error(*first, *second) for first, second in combinations(pairs, 2)]
    focals = [float(other.K[0, 0] / camera.K[0, 0]) for camera, other in pairs if other is not None]
    return Estimate(len(known), len(found), errors, focals, seconds)


def pose_error(first: Camera, found_first: Camera | None, second: Camera, found_second: Camera | None) -> float:
    """The error of the relative pose of two images in degrees; MAX_ERROR if one of them was not found."""
    if found_first is None or found_second is None:
        return MAX_ERROR
    known = invert_rigid(first.extrinsics) @ second.extrinsics
    found = invert_rigid(found_first.extrinsics) @ found_second.extrinsics
    turn = (np.trace(known[:3, :3].T @ found[:3, :3]) - 1) / 2
    lengths = np.linalg.norm(known[:3, 3]) * np.linalg.norm(found[:3, 3])
    cosine = min(turn, known[:3, 3] @ found[:3, 3] / lengths)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _row(name: str, estimates: Sequence[Estimate]) -> list[str]:
    """The cells of a row of the table."""
    shares = [estimate.registered / estimate.images for estimate in estimates]
    aucs = [np.mean([auc(estimate.errors, degrees) for estimate in estimates]) for degrees in AUC_DEGREES]
    focals = np.abs(np.concatenate([estimate.focals for estimate in estimates]) - 1)
    return [
        name,
        str(len(estimates)),
        f"{np.mean(shares):.0%}",
        f"{np.mean(np.equal(shares, 1)):.0%}",
        f"{np.mean([estimate.registered < 3 for estimate in estimates]):.0%}",
        *(f"{value:.3f}" for value in aucs),
        f"{np.median(focals):.1%}",
        f"{np.mean([estimate.seconds for estimate in estimates]):.1f}",
    ]


def auc(errors: Sequence[float], degrees: float) -> float:
    """The area under the curve of the share of errors that are less, up to so many degrees, from 0 to 1."""
    return float(np.mean(np.clip(1 - np.asarray(errors) / degrees, 0, 1)))


def main() -> None:
    """Run the command."""
    run(estimate_windows)


if __name__ == "__main__":
    main()
