"""The directions from which views see Gaussians: colours of SH of degree 1 are linear in them.

What such colours have to show differs from view to view: highlights, and what small errors of depth and cameras make of
a texture, however near to each other the cameras are. So it takes steeper colours, the less the directions spread, down
to a least spread: steeper ones are garish from aside.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.rigid import invert_rigid
from ..splats.surfaces import project_to_pixel
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from .rasterizer import Target

LEAST_SPREAD = 0.15  # nine degrees
BLOCK = 1 << 14  # Gaussians of one task


@dataclass(frozen=True, eq=False)
class ViewDirections:
    """Where Gaussians are seen from.

    means: of the unit directions to a Gaussian from the cameras that have it in their images, float32 [gaussians, 3];
    0 for a Gaussian that fewer than two have. spread: the root mean square of the distances of the directions from
    their mean, LEAST_SPREAD at least.
    """

    means: np.ndarray
    spread: float


def view_directions(means: np.ndarray, views: Sequence[Target]) -> ViewDirections:
    """The directions of views to Gaussians with these means, [gaussians, 3]; whether others hide them is not asked."""
    viewmats, Ks = np.stack([view.viewmat for view in views]), np.stack([view.K for view in views])
    sizes = np.array([(view.height, view.width) for view in views])
    centres = np.stack([invert_rigid(viewmat)[:3, 3] for viewmat in viewmats])
    found = np.zeros((len(means), 3), np.float32)

    def find(block: int) -> None:
        part = slice(block * BLOCK, (block + 1) * BLOCK)
        _find(means[part], viewmats, Ks, sizes, centres, found[part])

    map_in_threads(find, -(-len(means) // BLOCK))
    # The mean squared distance of unit vectors from their mean is 1 less the squared length of the mean.
    squared = np.square(found[found.any(axis=1)], dtype=np.float64).sum(axis=1)
    spread = float(np.sqrt(max(1 - squared.mean(), 0))) if len(squared) else 0.0
    return ViewDirections(found, max(spread, LEAST_SPREAD))


@compiled()
def _find(
    means: np.ndarray,  # [gaussians, 3]
    viewmats: np.ndarray,  # [views, 4, 4]
    Ks: np.ndarray,  # [views, 3, 3], in pixels
    sizes: np.ndarray,  # [views, 2]: heights and widths
    centres: np.ndarray,  # [views, 3]
    found: np.ndarray,  # [gaussians, 3]: to fill
) -> None:
    """Fill in the mean directions of Gaussians that two views or more have in their images."""
    for index in range(len(means)):
        x, y, z, count = 0.0, 0.0, 0.0, 0
        for view in range(len(viewmats)):
            height, width = sizes[view]
            if project_to_pixel(means[index], viewmats[view], Ks[view], height, width)[1] < 0:
                continue
            across, down, along = means[index] - centres[view]
            distance = np.sqrt(across * across + down * down + along * along)
            x, y, z = x + across / distance, y + down / distance, z + along / distance
            count += 1
        if count > 1:
            found[index, 0], found[index, 1], found[index, 2] = x / count, y / count, z / count
