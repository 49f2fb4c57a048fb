"""The surfaces that depth maps show, and Gaussians fitted to them, so that no camera sees between them.

Networks predict splats of about a pixel's size, nearly round. In their own view they close the surface. Where it is
slanted, its samples lie farther apart along the slope, and a camera that sees it from aside looks through between them.

Let r = [x, y, 1] be the ray of a pixel, z its depth, and a the slope of the surface: how far it goes along r for a step
across the ray at that depth. A Gaussian is sheared along its ray,

    Sigma' = M Sigma M^T,    M = I + r [a_x, a_y, -(a_x x + a_y y)],

which moves nothing across the rays: its image in its own view stays, and a ball becomes an ellipsoid in the surface.
What other views see through keeps its shape, as wrong surfaces should not hide right ones.

Where two views show one surface, their nearly opaque Gaussians compete: the layer that is nearer by a hair hides the
other. With less opacity their colours mix. The more views show it, the more densely they sample it, so that less
opaque and smaller Gaussians close it as well, and mix less of what their depths make disagree.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.consistency import DEPTH_TOLERANCE
from ..system.compilation import compiled
from .gaussians import Gaussians
from .merging import covariances, ellipsoids
from .surfaces import Surfaces, project_to_pixel

PAIR = 2  # views; the network was trained to predict Gaussians of two views that mix
SHARED_OPACITY = 0.75  # of two views, what a Gaussian of a surface that both show keeps of its opacity
# With more views: 1 - the light that opaque Gaussians of all views of a surface let through together, and what a
# Gaussian of such a surface keeps of its scales.
TOTAL_OPACITY, SHARED_SCALE = 0.99, 0.75


@dataclass(frozen=True, eq=False)
class Votes:
    """What the kept surfaces of the neighbours say of each Gaussian of a view, [height * width] each.

    confirmed: views whose depth agrees. seen_through: views that see a surface behind it. denser: whether a view that
    confirms it samples the surface more densely.
    """

    confirmed: np.ndarray
    seen_through: np.ndarray
    denser: np.ndarray


def ask_neighbors(surfaces: Surfaces, kept: np.ndarray, view: int) -> Votes:
    """The votes on the Gaussians of a view; kept: the pixels whose Gaussians are kept, bool [views, height, width]."""
    s, spacings = surfaces, surfaces.spacings
    confirmed, seen_through = np.zeros((2, *kept[view].shape), np.int32)
    denser = np.zeros(kept[view].shape, bool)
    _count(
        s.points[view], spacings[view], s.neighbors[view], s.depth, spacings, kept, s.viewmats, s.Ks,
        confirmed, seen_through, denser,
    )  # fmt: skip
    return Votes(confirmed.ravel(), seen_through.ravel(), denser.ravel())


def fit_to_surface(gaussians: Gaussians, surfaces: Surfaces, votes: Votes, kept: np.ndarray, view: int) -> Gaussians:
    """The Gaussians of a view, one for each pixel, in shapes that close the surface.

    Those of surfaces that no more neighbours see through than confirm are sheared along their rays, except where a
    neighbour has denser samples of the surface. kept: the pixels whose Gaussians are kept, bool [views, height, width].
    """
    stretched = (votes.confirmed >= votes.seen_through) & ~votes.denser
    members = np.flatnonzero(stretched & kept[view].ravel())
    shear = _shears(surfaces, view, members)
    scales, quats = gaussians.scales.copy(), gaussians.quats.copy()
    scales[members], quats[members] = ellipsoids(shear @ covariances(gaussians, members) @ shear.swapaxes(1, 2))
    return replace(gaussians, scales=scales, quats=quats)


def mix_views(gaussians: Gaussians, votes: Votes, views: int) -> Gaussians:
    """The Gaussians of a view with those of shared surfaces less opaque and, with more than two views, smaller.

    With more than two views, those that neighbours see through lose opacity, too: the share of the votes against them.
    """
    shared = votes.confirmed > 0
    if views == PAIR:
        opacities = np.where(shared, SHARED_OPACITY, 1)
        return replace(gaussians, opacities=gaussians.opacities * opacities.astype(np.float32))
    copies = votes.confirmed + 1
    opacities = np.where(shared, 1 - (1 - TOTAL_OPACITY) ** (1 / copies), 1) * copies / (copies + votes.seen_through)
    scales = np.where(shared, SHARED_SCALE, 1)[:, None].astype(np.float32)
    return replace(
        gaussians,
        scales=gaussians.scales * scales,
        opacities=gaussians.opacities * opacities.astype(np.float32),
    )


def _shears(surfaces: Surfaces, view: int, members: np.ndarray) -> np.ndarray:
    """M in world axes, [members, 3, 3], of some pixels of a view."""
    rays, slopes = surfaces.rays(view).reshape(-1, 3)[members], surfaces.slopes[view].reshape(-1, 2)[members]
    along = np.concatenate([slopes, -(slopes * rays[:, :2]).sum(axis=1, keepdims=True)], axis=1)
    rotation = surfaces.extrinsics[view, :3, :3]
    return np.eye(3) + (rays @ rotation.T)[:, :, None] * (along @ rotation.T)[:, None, :]


@compiled()
def _count(
    points: np.ndarray,  # [height, width, 3]
    spacing: np.ndarray,  # [height, width]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    spacings: np.ndarray,  # [views, height, width]
    kept: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    confirmed: np.ndarray,  # [height, width]
    seen_through: np.ndarray,  # [height, width]
    denser: np.ndarray,  # [height, width]
) -> None:
    """Fill what `Votes` holds."""
    height, width = denser.shape
    for row in range(height):
        for column in range(width):
            for view in neighbors:
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not kept[view, y, x]:
                    continue
                surface = depth[view, y, x]
                if z < surface * (1 - DEPTH_TOLERANCE):
                    seen_through[row, column] += 1
                elif z <= surface * (1 + DEPTH_TOLERANCE):
                    confirmed[row, column] += 1
                    denser[row, column] |= spacings[view, y, x] < spacing[row, column]
