"""The surfaces that depth maps show, and Gaussians fitted to them, so that no camera sees between them.

Networks predict splats of about a pixel's size, nearly round. In their own view they close the surface. Where it is
slanted, its samples lie farther apart along the slope, and a camera that sees it from aside looks through between them.

Let r = [x, y, 1] be the ray of a pixel, z its depth, and a the slope of the surface: how far it goes along r for a step
across the ray at that depth. A Gaussian is sheared along its ray,

    Sigma' = M Sigma M^T,    M = I + r [a_x, a_y, -(a_x x + a_y y)],

which moves nothing across the rays: its image in its own view stays, and a ball becomes an ellipsoid in the surface.
What other views see through keeps its shape, as wrong surfaces should not hide right ones.

Where two views show one surface, their nearly opaque Gaussians compete: the layer that is nearer by a hair hides the
other. With less opacity their colours mix. They also sample it twice as densely as one view does, so that smaller ones
close it as well, and mix less of what their depths make disagree.
"""

from dataclasses import replace

import numpy as np

from ..geometry.consistency import DEPTH_TOLERANCE
from ..system.compilation import compiled
from .gaussians import Gaussians
from .merging import covariances, ellipsoids
from .surfaces import Surfaces, project_to_pixel

MIN_SMALLER_VIEWS = 3  # the network was trained to predict Gaussians of two views that mix
# What a Gaussian of a surface that another view shows, too, keeps of its opacity and its scales.
SHARED_OPACITY, SHARED_SCALE = 0.75, 1.0
SMALLER_OPACITY, SMALLER_SCALE = 0.9, 0.75  # with MIN_SMALLER_VIEWS


def fit_to_surface(
    gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray, view: int
) -> tuple[Gaussians, np.ndarray]:
    """The Gaussians of a view, one for each pixel, in shapes that close the surface, and which are shared.

    Those of surfaces that no more neighbours contradict than confirm are sheared along their rays, except where a
    neighbour has denser samples of the surface. Those that a neighbour confirms are shared, bool [height * width].
    kept: the pixels whose Gaussians are kept, bool [views, height, width].
    """
    spacings, (stretched, shared) = surfaces.spacings, np.zeros((2, *kept[view].shape), bool)
    _ask_neighbors(
        surfaces.points[view], spacings[view], surfaces.neighbors[view], surfaces.depth, spacings,
        kept, surfaces.viewmats, surfaces.Ks, stretched, shared,
    )  # fmt: skip
    members = np.flatnonzero(stretched & kept[view])
    shear = _shears(surfaces, view, members)
    scales, quats = gaussians.scales.copy(), gaussians.quats.copy()
    scales[members], quats[members] = ellipsoids(shear @ covariances(gaussians, members) @ shear.swapaxes(1, 2))
    return replace(gaussians, scales=scales, quats=quats), shared.ravel()


def mix_views(gaussians: Gaussians, shared: np.ndarray, views: int) -> Gaussians:
    """The Gaussians with the shared ones less opaque and, with MIN_SMALLER_VIEWS, smaller; shared: bool [gaussians]."""
    smaller = views >= MIN_SMALLER_VIEWS
    opacity, scale = (SMALLER_OPACITY, SMALLER_SCALE) if smaller else (SHARED_OPACITY, SHARED_SCALE)
    scales, opacities = gaussians.scales.copy(), gaussians.opacities.copy()
    opacities[shared] *= np.float32(opacity)
    scales[shared] *= np.float32(scale)
    return replace(gaussians, scales=scales, opacities=opacities)


def _shears(surfaces: Surfaces, view: int, members: np.ndarray) -> np.ndarray:
    """M in world axes, [members, 3, 3], of some pixels of a view."""
    rays, slopes = surfaces.rays(view).reshape(-1, 3)[members], surfaces.slopes[view].reshape(-1, 2)[members]
    along = np.concatenate([slopes, -(slopes * rays[:, :2]).sum(axis=1, keepdims=True)], axis=1)
    rotation = surfaces.extrinsics[view, :3, :3]
    return np.eye(3) + (rays @ rotation.T)[:, :, None] * (along @ rotation.T)[:, None, :]


@compiled()
def _ask_neighbors(
    points: np.ndarray,  # [height, width, 3]
    spacing: np.ndarray,  # [height, width]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    spacings: np.ndarray,  # [views, height, width]
    kept: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    stretched: np.ndarray,  # [height, width]
    shared: np.ndarray,  # [height, width]
) -> None:
    """Find the pixels whose Gaussians are sheared, and those that a neighbour confirms: see `fit_to_surface`."""
    height, width = stretched.shape
    for row in range(height):
        for column in range(width):
            confirmed, against, denser = 0, 0, False
            for view in neighbors:
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not kept[view, y, x]:
                    continue
                surface = depth[view, y, x]
                if z < surface * (1 - DEPTH_TOLERANCE):
                    against += 1
                elif z <= surface * (1 + DEPTH_TOLERANCE):
                    confirmed += 1
                    denser = denser or spacings[view, y, x] < spacing[row, column]
            stretched[row, column] = confirmed >= against and not denser
            shared[row, column] = confirmed > 0
