"""Fusion of the views' Gaussians: those that other views contradict are removed, before they hide what is right.

A point is supported by a view whose depth and colour agree with it, and contradicted by a view that sees a surface
behind it, or one of another colour at its place: that view looks through the point. What only one view sees is neither.
Only a surface that is supported itself speaks against a point, so that a wrong depth map does not remove a right one.
Of what is left, few copies of each surface stay.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import cv2
import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..system.compilation import compiled

DEPTH_TOLERANCE = 0.02  # relative difference in depth up to which two views agree
# A colour agrees with a view's if it is within COLOR_TOLERANCE of what COLOR_WINDOW x COLOR_WINDOW pixels span there:
# fine texture is sampled differently by each view, and highlights move.
COLOR_TOLERANCE = 0.15
COLOR_WINDOW = 5
ROUNDS = 3  # a point that is removed no longer contradicts others
# A point is contradicted if the votes against it exceed VOTE_RATIO (MIN_SUPPORT + support).
MIN_SUPPORT = 0.5
VOTE_RATIO = 0.7
MIN_VOTING_VIEWS = 3  # with two views, a contradiction does not tell which of both is wrong
COPIES = 2  # views whose points of one surface are kept
COARSER = 1.5  # times the depth, from where a surface is sampled too coarsely to stand for another copy


class Surfaces:
    """The depth maps of posed views, with the views that are asked about each view's points."""

    def __init__(
        self,
        points: np.ndarray,
        depth: np.ndarray,
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        images: np.ndarray | None = None,
        neighbors: list[np.ndarray] | None = None,
    ) -> None:
        """Keep the views in the form that compiled code reads.

        points: world positions of the pixels, [views, height, width, 3]. depth: z-depth, [views, height, width].
        extrinsics: camera-to-world, [views, 4, 4]. intrinsics: normalised, [views, 3, 3]. images: RGB in [0, 1],
        [views, 3, height, width]; without, colours are not compared. neighbors: the views that are asked about each
        view, as arrays of indices; by default all others.
        """
        views, height, width = depth.shape
        if neighbors is None:
            neighbors = [np.delete(np.arange(views), view) for view in range(views)]
        self.neighbors = neighbors
        self.points, self.depth = (np.ascontiguousarray(array, np.float32) for array in (points, depth))
        viewmats = np.stack([invert_rigid(pose) for pose in extrinsics.astype(np.float64)])
        self.cameras = viewmats, denormalize_intrinsics(intrinsics, width, height).astype(np.float64)
        self.images = images

    @cached_property
    def color_ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours of the pixels, and the least and greatest that agree with each, uint8 [views, height, width, 3]."""
        if self.images is None:
            nothing = np.zeros((*self.depth.shape, 3), np.uint8)
            return nothing, nothing, nothing
        colors = np.ascontiguousarray((np.clip(self.images, 0, 1) * 255).astype(np.uint8).transpose(0, 2, 3, 1))
        window = np.ones((COLOR_WINDOW, COLOR_WINDOW), np.uint8)
        tolerance = round(255 * COLOR_TOLERANCE)
        least = np.stack([np.maximum(cv2.erode(image, window), tolerance) - tolerance for image in colors])
        most = np.stack([np.minimum(cv2.dilate(image, window), 255 - tolerance) + tolerance for image in colors])
        return colors, least, most


def find_contradicted(surfaces: Surfaces) -> np.ndarray:
    """The points that other views see through, bool [views, height, width]."""
    s, shape = surfaces, surfaces.depth.shape
    colors, least, most = s.color_ranges
    support, against = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    kept = np.ones(shape, bool)

    def count_support(view: int) -> None:
        of_view = s.points[view], colors[view], s.neighbors[view]
        _support(*of_view, s.depth, *s.cameras, least, most, support[view])

    def count_against(view: int) -> None:
        of_view = s.points[view], colors[view], s.neighbors[view]
        _against(*of_view, s.depth, *s.cameras, least, most, solid, against[view])

    with ThreadPoolExecutor(min(len(s.depth), os.cpu_count() or 1)) as pool:
        list(pool.map(count_support, range(len(s.depth))))
        for _ in range(ROUNDS):
            solid = kept & (support > 0)
            list(pool.map(count_against, range(len(s.depth))))
            np.less_equal(against, VOTE_RATIO * (support + MIN_SUPPORT), out=kept)
    return ~kept


def find_redundant(surfaces: Surfaces, kept: np.ndarray) -> np.ndarray:
    """The points of surfaces that COPIES earlier views show as finely, bool [views, height, width].

    kept: the points that take part, bool [views, height, width]. More copies than that add nothing to the rendered
    views but time and memory, and small disagreements.
    """
    left = kept.copy()
    for view, neighbors in enumerate(surfaces.neighbors):
        earlier = neighbors[neighbors < view]
        if len(earlier) >= COPIES:
            _thin(surfaces.points[view], earlier, surfaces.depth, *surfaces.cameras, left, view)
    return kept & ~left


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
def _agrees(color: np.ndarray, least: np.ndarray, most: np.ndarray) -> bool:
    """Whether a colour [3] is within a range."""
    red = least[0] <= color[0] <= most[0]
    return red and least[1] <= color[1] <= most[1] and least[2] <= color[2] <= most[2]


@compiled()
def _support(
    points: np.ndarray,  # [height, width, 3]
    colors: np.ndarray,  # [height, width, 3]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    least: np.ndarray,  # [views, height, width, 3]
    most: np.ndarray,
    support: np.ndarray,  # [height, width]
) -> None:
    """Count the neighbours whose depth and colour agree with each point of a view."""
    height, width = support.shape
    for row in range(height):
        for column in range(width):
            count = 0
            for view in neighbors:
                z, y, x = _project(points[row, column], viewmats[view], Ks[view], height, width)
                if y >= 0 and abs(z - depth[view, y, x]) <= DEPTH_TOLERANCE * depth[view, y, x]:
                    count += _agrees(colors[row, column], least[view, y, x], most[view, y, x])
            support[row, column] = count


@compiled()
def _against(
    points: np.ndarray,
    colors: np.ndarray,
    neighbors: np.ndarray,
    depth: np.ndarray,
    viewmats: np.ndarray,
    Ks: np.ndarray,
    least: np.ndarray,
    most: np.ndarray,
    solid: np.ndarray,  # [views, height, width]
    against: np.ndarray,  # [height, width]
) -> None:
    """Count the neighbours that see a solid surface behind each point of a view, or of another colour at its place."""
    height, width = against.shape
    for row in range(height):
        for column in range(width):
            votes = 0
            for view in neighbors:
                z, y, x = _project(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not solid[view, y, x] or z >= depth[view, y, x] * (1 + DEPTH_TOLERANCE):
                    continue
                before = z < depth[view, y, x] * (1 - DEPTH_TOLERANCE)
                if before or not _agrees(colors[row, column], least[view, y, x], most[view, y, x]):
                    votes += 1
            against[row, column] = votes


@compiled()
def _thin(
    points: np.ndarray,  # [height, width, 3]
    earlier: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    left: np.ndarray,  # [views, height, width]
    own: int,
) -> None:
    """Clear the points of the view `own` of which COPIES earlier views have a point left, about as finely sampled."""
    height, width = points.shape[:2]
    for row in range(height):
        for column in range(width):
            copies = 0
            for view in earlier:
                z, y, x = _project(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not left[view, y, x] or z > COARSER * depth[own, row, column]:
                    continue
                copies += abs(z - depth[view, y, x]) <= DEPTH_TOLERANCE * depth[view, y, x]
            if copies >= COPIES:
                left[own, row, column] = False
