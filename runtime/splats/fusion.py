"""Fusion of the views' Gaussians: those that other views contradict are removed, before they hide what is right.

A point is supported by a view whose depth agrees with it, and contradicted by a view that sees a surface behind it:
that view looks through the point. What only one view sees is neither. Only a surface that is supported itself speaks
against a point, so that a wrong depth map does not remove a right one.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..system.compilation import compiled

DEPTH_TOLERANCE = 0.02  # relative difference in depth up to which two views agree
ROUNDS = 3  # a point that is removed no longer contradicts others
# A point is contradicted if the votes against it exceed VOTE_RATIO (MIN_SUPPORT + support).
MIN_SUPPORT = 0.5
VOTE_RATIO = 0.7
MIN_VOTING_VIEWS = 3  # with two views, a contradiction does not tell which of both is wrong


def find_contradicted(
    points: np.ndarray,
    depth: np.ndarray,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    neighbors: list[np.ndarray] | None = None,
) -> np.ndarray:
    """The points that other views see through, bool [views, height, width].

    points: world positions of the pixels, [views, height, width, 3]. depth: z-depth, [views, height, width].
    extrinsics: camera-to-world, [views, 4, 4]. intrinsics: normalised, [views, 3, 3].
    neighbors: the views that vote on each view, as arrays of indices; by default all others.
    """
    views, height, width = depth.shape
    if neighbors is None:
        neighbors = [np.delete(np.arange(views), view) for view in range(views)]
    viewmats = np.stack([invert_rigid(pose) for pose in extrinsics.astype(np.float64)])
    cameras = viewmats, denormalize_intrinsics(intrinsics, width, height).astype(np.float64)
    points, depth = (np.ascontiguousarray(array, np.float32) for array in (points, depth))
    support, against = np.zeros(depth.shape, np.float32), np.zeros(depth.shape, np.float32)
    kept = np.ones(depth.shape, bool)

    def count_support(view: int) -> None:
        _support(points[view], neighbors[view], depth, *cameras, support[view])

    def count_against(view: int) -> None:
        _against(points[view], neighbors[view], depth, *cameras, support, kept, against[view])

    with ThreadPoolExecutor(min(views, os.cpu_count() or 1)) as pool:
        list(pool.map(count_support, range(views)))
        for _ in range(ROUNDS):
            list(pool.map(count_against, range(views)))
            np.less_equal(against, VOTE_RATIO * (support + MIN_SUPPORT), out=kept)
    return ~kept


@compiled()
def _project(point: np.ndarray, viewmat: np.ndarray, K: np.ndarray, height: int, width: int) -> tuple[float, int, int]:
    """The z-depth of a point, and the row and column of its pixel; the row is -1 outside the image."""
    x, y, z = point[0], point[1], point[2]
    depth = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
    if depth <= 0:
        return depth, -1, 0
    across = viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]
    down = viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]
    column, row = K[0, 0] * across / depth + K[0, 2], K[1, 1] * down / depth + K[1, 2]
    if not (0 <= column < width and 0 <= row < height):
        return depth, -1, 0
    return depth, int(row), int(column)


@compiled()
def _support(
    points: np.ndarray,  # [height, width, 3]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    support: np.ndarray,  # [height, width]
) -> None:
    """Count the neighbours whose depth agrees with each point of a view."""
    height, width = support.shape
    for row in range(height):
        for column in range(width):
            count = 0
            for view in neighbors:
                z, y, x = _project(points[row, column], viewmats[view], Ks[view], height, width)
                if y >= 0 and abs(z - depth[view, y, x]) <= DEPTH_TOLERANCE * depth[view, y, x]:
                    count += 1
            support[row, column] = count


@compiled()
def _against(
    points: np.ndarray,
    neighbors: np.ndarray,
    depth: np.ndarray,
    viewmats: np.ndarray,
    Ks: np.ndarray,
    support: np.ndarray,  # [views, height, width]
    kept: np.ndarray,  # [views, height, width]
    against: np.ndarray,  # [height, width]
) -> None:
    """Count the neighbours that see a supported surface behind each point of a view."""
    height, width = against.shape
    for row in range(height):
        for column in range(width):
            votes = 0
            for view in neighbors:
                z, y, x = _project(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not kept[view, y, x] or support[view, y, x] == 0:
                    continue
                if z < depth[view, y, x] * (1 - DEPTH_TOLERANCE):
                    votes += 1
            against[row, column] = votes
