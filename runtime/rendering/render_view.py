"""A scene as a camera sees it."""

import numpy as np

from ..geometry.rigid import invert_rigid
from ..splats.gaussians import Gaussians
from .rasterizer import rasterize
from .types import Rendering

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
        invert_rigid(extrinsics),
        K,
        width,
        height,
        background,
    )
