"""Rendering of Gaussians from cameras, on top of `rasterize`."""

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.rigid import invert_rigid
from ..splats.gaussians import Gaussians
from .rasterizer import rasterize
from .types import Rendering

BLACK = (0.0, 0.0, 0.0)
SOLID = 0.5  # alpha from which on a pixel has a depth
AUTO: Literal["auto"] = "auto"  # focus on what the first camera has in the middle of its image
FOCUS_SHARE = 0.2  # of either side of the image: the part in its middle that is brought into focus


def render(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    background: tuple[float, float, float] = BLACK,
    aperture: float = 0,
    focus: float | Literal["auto"] = AUTO,
) -> Iterator[Rendering]:
    """Render Gaussians from each camera at its own size, one view at a time, so that memory holds one.

    Lens distortion is ignored. background: RGB in [0, 1]. aperture: diameter of a thin lens in world units, 0 for a
    pinhole; focus: z-depth of the plane in focus in world units, or "auto" for `autofocus` with the first camera.
    Raises InputError as `rasterize` and `autofocus` do, when the view is taken from the iterator.

        for camera, view in zip(cameras, render(gaussians, cameras)):
            save_png(Path(camera.name).with_suffix(".png"), view.rgb)
    """
    distance = _distance(focus)
    for camera in cameras:
        if aperture > 0 and distance is None:
            distance = autofocus(gaussians, camera)
        size = camera.width, camera.height
        yield render_view(gaussians, camera.extrinsics, camera.K, *size, background, aperture, distance)


def render_view(
    gaussians: Gaussians,
    extrinsics: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    width: int,
    height: int,
    background: tuple[float, float, float] = BLACK,
    aperture: float = 0,
    focus: float | None = None,
) -> Rendering:
    """Render Gaussians from one camera: extrinsics camera-to-world, OpenCV axes; K in pixels.

    aperture, focus: of a thin lens, as in `rasterize`. Raises InputError as that does.
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
        aperture=aperture,
        focus=focus,
    )


def _distance(focus: float | Literal["auto"]) -> float | None:
    """The distance in focus, None for "auto"; raises InputError for another text."""
    if isinstance(focus, str):
        if focus != AUTO:
            raise InputError(f"render: focus is {focus}, expected a z-depth in world units, or {AUTO}")
        return None
    return focus


def autofocus(gaussians: Gaussians, camera: Camera) -> float:
    """Median z-depth, in world units, of what the camera has in the middle of its image.

    The middle is FOCUS_SHARE of the width and of the height. Raises InputError if nothing is there.
    """
    width, height = (max(round(FOCUS_SHARE * side), 1) for side in (camera.width, camera.height))
    K = camera.K.copy()
    K[:2, 2] -= (camera.width - width) / 2, (camera.height - height) / 2
    depth = median_depth(render_view(gaussians, camera.extrinsics, K, width, height))
    if depth is None:
        raise InputError(
            f"the camera {camera.name} has nothing in the middle of its image to focus on; give a focus distance"
        )
    return depth


def median_depth(rendering: Rendering) -> float | None:
    """Median z-depth in world units of the pixels with alpha >= SOLID; None if there are none."""
    solid = rendering.alpha >= SOLID
    return float(np.median(rendering.depth[solid] / rendering.alpha[solid])) if solid.any() else None
