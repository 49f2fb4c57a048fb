"""A scene as a camera sees it."""

import numpy as np

from .gaussians import Gaussians
from .rasterizer import Rendering, rasterize

BLACK = (0.0, 0.0, 0.0)


def draw_view(
    gaussians: Gaussians,
    extrinsics: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    width: int,
    height: int,
    background: tuple[float, float, float] = BLACK,
) -> Rendering:
    """Draw Gaussians from a camera given as the rest of the package has it: camera-to-world, K in pixels.

    Raises InputError as `rasterize` does.
    """
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        world_to_camera(extrinsics),
        K,
        width,
        height,
        background,
    )


def world_to_camera(extrinsics: np.ndarray) -> np.ndarray:
    """The viewmat [4, 4] of a rigid camera-to-world pose [4, 4]."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = extrinsics[:3, :3].T
    viewmat[:3, 3] = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    return viewmat
