"""Rendering of Gaussians from cameras, on top of `rasterize`."""

from collections.abc import Iterable, Iterator

import numpy as np

from ..cameras.camera import Camera
from ..geometry.rigid import invert_rigid
from ..splats.gaussians import Gaussians
from .rasterizer import rasterize
from .types import Rendering

BLACK = (0.0, 0.0, 0.0)


def render(
    gaussians: Gaussians, cameras: Iterable[Camera], background: tuple[float, float, float] = BLACK
) -> Iterator[Rendering]:
    """Render Gaussians from each camera at its own size, one view at a time, so that memory holds one.

    Lens distortion is ignored: every camera is rendered as a pinhole. background: RGB in [0, 1].
    Raises InputError as `rasterize` does, when the view is taken from the iterator.

        for camera, view in zip(cameras, render(gaussians, cameras)):
            save_png(Path(camera.name).with_suffix(".png"), view.rgb)
    """
    for camera in cameras:
        yield render_view(gaussians, camera.extrinsics, camera.K, camera.width, camera.height, background)


def render_view(
    gaussians: Gaussians,
    extrinsics: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    width: int,
    height: int,
    background: tuple[float, float, float] = BLACK,
) -> Rendering:
    """Render Gaussians from one pinhole camera: extrinsics camera-to-world, OpenCV axes; K in pixels.

    Raises InputError as `rasterize` does.
    """
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        invert_rigid(extrinsics),
        K,
        width,
        height,
        background,
    )
