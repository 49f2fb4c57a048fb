"""Depth discontinuities within depth maps, and consistency between those of several views."""

from collections.abc import Sequence

import numpy as np

DEPTH_TOLERANCE = 0.05  # relative difference in depth up to which two views agree


def depth_jumps(depth: np.ndarray) -> np.ndarray:
    """Relative depth range, max / min - 1, in each 3 x 3 window of depth [views, height, width]; of the same shape."""
    import cv2

    square = np.ones((3, 3), np.uint8)
    return np.stack([cv2.dilate(view, square) / cv2.erode(view, square) - 1 for view in depth])


def multi_view_consistency(
    points: np.ndarray,
    depth: np.ndarray,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    neighbors: Sequence[np.ndarray] | None = None,
) -> np.ndarray:
    """The fraction of the other views that agree with each point, float32 [views, height, width].

    points: world positions of the pixels, [views, height, width, 3]. depth: z-depth, [views, height, width].
    extrinsics: camera-to-world, [views, 4, 4]. intrinsics: normalised, [views, 3, 3]. neighbors: the views that are
    asked about each view, as arrays of indices; by default all others.
    A view agrees with a point within 5 % of its own depth there, and disagrees with a point in front of that. It
    abstains on points outside its image, and on points behind its surface, which are occluded. Without votes a point
    gets 1.
    With two views, a disagreement does not tell which of both is wrong.
    """
    import cv2

    square = np.ones((3, 3), np.uint8)  # points project between pixels, so their neighbours count as well
    agree, disagree = np.zeros(depth.shape, np.float32), np.zeros(depth.shape, np.float32)
    for other, surface in enumerate(depth):
        nearest, farthest = cv2.erode(surface, square), cv2.dilate(surface, square)
        for view in range(len(depth)):
            if view == other or (neighbors is not None and other not in neighbors[view]):
                continue
            pixel, z, seen = project_to_view(points[view], surface.shape, extrinsics[other], intrinsics[other])
            behind_nearest = z >= nearest.ravel()[pixel] * (1 - DEPTH_TOLERANCE)
            before_farthest = z <= farthest.ravel()[pixel] * (1 + DEPTH_TOLERANCE)
            agree[view] += seen & behind_nearest & before_farthest
            disagree[view] += seen & ~behind_nearest
    votes = agree + disagree
    return np.where(votes > 0, agree / np.maximum(votes, 1), 1).astype(np.float32)


def project_to_view(
    points: np.ndarray, shape: tuple[int, ...], extrinsics: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Projection of points [..., 3] into one view: pixel index (row * width + column), z-depth, is it in the image.

    shape: height and width. Pixel indices of points outside the image are 0.
    """
    height, width = shape
    local = (points - extrinsics[:3, 3]) @ extrinsics[:3, :3]  # [..., 3]
    z = local[..., 2]
    x, y, _ = np.moveaxis(local / np.where(z > 0, z, 1)[..., None] @ intrinsics.T, -1, 0)
    seen = (z > 0) & (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
    column, row = (np.where(seen, values, 0) * size for values, size in ((x, width), (y, height)))
    pixel = np.minimum(row.astype(np.int64), height - 1) * width + np.minimum(column.astype(np.int64), width - 1)
    return pixel, z, seen
