"""Background that goes on behind depth edges, so that a camera beside the views sees no gap there."""

from dataclasses import replace

import numpy as np

from ..geometry.consistency import DEPTH_TOLERANCE, depth_jumps
from ..geometry.rigid import transform_points
from ..system.compilation import compiled
from .gaussians import Gaussians
from .surfaces import MAX_STEP, Surfaces, project_to_pixel

CONTINUED = 6  # pixels behind the edge
MIN_GAP = 0.1  # between foreground and background, relative difference in depth


def continue_background(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray, view: int) -> Gaussians:
    """Copies of a view's Gaussians on the far side of depth edges, up to CONTINUED pixels behind the near side.

    gaussians: one for each pixel of the view. kept: the pixels whose Gaussians are kept, bool [views, height, width].
    The copies lie on the tangent plane of what they continue, and only where the
    surfaces of this and the neighbouring views hide them.
    """
    depth = surfaces.depth[view]
    source, continued = np.full(depth.shape, -1), np.zeros(depth.shape)
    smooth = depth_jumps(depth[None])[0] <= MAX_STEP
    _find_sources(depth, surfaces.slopes[view], surfaces.Ks[view], smooth & kept[view], source, continued)
    row, column = np.nonzero(source >= 0)
    local = surfaces.rays(view)[row, column] * continued[row, column, None]
    points = transform_points(surfaces.extrinsics[view], local)
    hidden = np.zeros(len(points), bool)
    find_hidden(points, surfaces.neighbors[view], surfaces.depth, kept, surfaces.viewmats, surfaces.Ks, hidden)
    row, column, points = row[hidden], column[hidden], points[hidden]
    copied = source[row, column]
    copies = gaussians.select(copied)
    growth = (continued[row, column] / depth.ravel()[copied]).astype(np.float32)
    return replace(copies, means=points.astype(np.float32), scales=copies.scales * growth[:, None])


@compiled()
def _find_sources(
    depth: np.ndarray,  # [height, width]
    slopes: np.ndarray,  # [height, width, 2]
    K: np.ndarray,
    sources: np.ndarray,  # [height, width]: the pixels that may be continued
    source: np.ndarray,  # [height, width], -1
    continued: np.ndarray,  # [height, width]
) -> None:
    """Fill the index of the nearest pixel whose tangent plane passes behind each one, and the depth of the plane."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            for distance in range(1, CONTINUED + 1):
                nearest = 1 / (depth[row, column] * (1 + MIN_GAP))
                for down in range(-1, 2):
                    for right in range(-1, 2):
                        y, x = row + distance * down, column + distance * right
                        inside = 0 <= y < height and 0 <= x < width and (down != 0 or right != 0)
                        if not inside or not sources[y, x]:
                            continue
                        slope = slopes[y, x, 0] * right / K[0, 0] + slopes[y, x, 1] * down / K[1, 1]
                        inverse = (1 + distance * slope) / depth[y, x]  # of the plane, back at this pixel
                        if 0 < inverse < nearest:
                            nearest = inverse
                            source[row, column] = y * width + x
                            continued[row, column] = 1 / inverse
                if source[row, column] >= 0:
                    break


@compiled()
def find_hidden(
    points: np.ndarray,  # [points, 3]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    kept: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    hidden: np.ndarray,  # [points]
) -> None:
    """Find the points that are behind the surface of every neighbour that has them in its image."""
    height, width = depth.shape[1:]
    for index in range(len(points)):
        hidden[index] = True
        for view in neighbors:
            z, y, x = project_to_pixel(points[index], viewmats[view], Ks[view], height, width)
            if y >= 0 and kept[view, y, x] and z < depth[view, y, x] * (1 + DEPTH_TOLERANCE):
                hidden[index] = False
                break
