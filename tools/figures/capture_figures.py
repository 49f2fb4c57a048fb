"""Figures of real captures: the prediction alone and the finished scene, at a held-out camera and from the side.

python -P -m idesplat.tools.figures.capture_figures --checkouts DIR --out docs/images can cup
"""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from ...runtime.cameras.camera import Camera, resize_camera
from ...runtime.cli.terminal import run, say
from ...runtime.images.colormaps import to_uint8
from ...runtime.reconstruction.pipeline import reconstruct
from ...runtime.reconstruction.quality import Quality
from ...runtime.rendering.cameras import orbit_cameras
from ...runtime.rendering.render import render_view
from ...runtime.splats.gaussians import Gaussians
from ...runtime.system.files import atomic_write, make_folder
from ..evaluation.captures.capture import Capture, load_cropped, read_captures
from ..evaluation.captures.checkouts import frames_of

VIEWS = 6
SIDE = 384  # pixels: longer side of each rendering
DEGREES = 30  # swing of the orbit; its quarter is half of that to one side
JPEG_QUALITY = 90


def figures(
    names: Annotated[list[str], typer.Argument(help="Captures.", show_default=False)],
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    out: Annotated[Path, typer.Option(help="Folder for capture-NAME.jpg.")],
) -> None:
    """Write capture-NAME.jpg: prediction and finished scene at a held-out camera, and both from the side."""
    for capture in read_captures(names):
        path = make_folder(out) / f"capture-{capture.name}.jpg"
        with frames_of(checkouts, capture) as folder:
            row = _row(capture, folder)
        image = np.ascontiguousarray(to_uint8(np.hstack(row))[..., ::-1])
        with atomic_write(path) as temporary:
            temporary.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
        say(f"wrote {path}")


def _row(capture: Capture, folder: Path) -> list[np.ndarray]:
    context, held_out = capture.window(VIEWS)
    cameras = [capture.cameras[name] for name in context]
    images = [load_cropped(folder / name, capture.crop) for name in context]
    before, after = (
        reconstruct(images, cameras, quality=quality, views="all").gaussians
        for quality in (Quality.FAST, Quality.STANDARD)
    )
    assert before is not None and after is not None, "the bundled model predicts Gaussians"
    target = capture.cameras[held_out[len(held_out) // 2]]
    side = orbit_cameras(after, cameras, DEGREES, 4)[1]
    return [_render(gaussians, camera) for camera in small_cameras(target, side) for gaussians in (before, after)]


def small_cameras(first: Camera, *others: Camera) -> list[Camera]:
    """The cameras with images of the shape of the first's, SIDE pixels on the longer side.

    Photographs that were undistorted one by one differ by some pixels.
    """
    factor = SIDE / max(first.width, first.height)
    size = round(first.width * factor), round(first.height * factor)
    return [resize_camera(camera, *size) for camera in (first, *others)]


def _render(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    return render_view(gaussians, camera.extrinsics, camera.K, camera.width, camera.height).rgb


def main() -> None:
    """Run the command."""
    run(figures)


if __name__ == "__main__":
    main()
