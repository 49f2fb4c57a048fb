"""Fusion of the views' Gaussians: those that other views contradict are removed, before they hide what is right.

A point is supported by a view whose depth and colour agree with it, and contradicted by a view that sees a surface
behind it, or one of another colour at its place: that view looks through the point. What only one view sees is neither.
A wrong point before a surface of its own colour shows little, so that such a contradiction may count less.
Only a surface that is supported itself speaks against a point, so that a wrong depth map does not remove a right one.
So where all views disagree, none contradicts; a point that most of them disagree with is removed as well, unless its
own view would then have a hole there, and it hides the surfaces of few others.
Of what is left, few copies of each surface stay: those of the views in the middle, which are less far from any camera.
"""

from collections.abc import Callable

import cv2
import numpy as np

from ..geometry.consistency import multi_view_consistency
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from .surfaces import Surfaces, color_agrees, project_to_pixel

DEPTH_TOLERANCE = 0.02  # relative difference in depth up to which two views agree
ROUNDS = 3  # a point that is removed no longer contradicts others
# A point is contradicted if the votes against it exceed VOTE_RATIO (MIN_SUPPORT + support).
MIN_SUPPORT = 0.5
VOTE_RATIO = 0.7
MIN_CONSISTENCY = 0.5  # share of the neighbours whose surface is at a point or behind it that must agree with it
MANY_HIDDEN = 6  # views whose surfaces a point hides, from where it does more harm than the hole that it leaves
MIN_MAJORITY_VIEWS = 4  # from which on most views can outvote one; of three, two that disagree may both be wrong
MIN_VOTING_VIEWS = 3  # with two views, a contradiction does not tell which of both is wrong
COARSER = 1.5  # times the depth, from where a surface is sampled too coarsely to stand for another copy


def find_contradicted(surfaces: Surfaces, same_color: float = 1.0) -> np.ndarray:
    """The points that other views see through, or most disagree with, bool [views, height, width].

    same_color: the vote of a view that sees a surface of the point's own colour behind it; that of another view is 1.
    Those that most disagree with count only with MIN_MAJORITY_VIEWS, and where their view has no need of them: where
    points of the neighbours that are kept cover their pixel, or they hide the surfaces of MANY_HIDDEN views.
    """
    s, support = surfaces, _votes(surfaces, _support)
    kept = np.ones(support.shape, bool)
    for _ in range(ROUNDS):
        kept = _votes(s, _against, kept & (support > 0), same_color) <= VOTE_RATIO * (support + MIN_SUPPORT)
    if len(s.depth) < MIN_MAJORITY_VIEWS:
        return ~kept
    consistency = multi_view_consistency(s.points, s.depth, s.extrinsics, s.intrinsics, s.neighbors)
    agreed = kept & (consistency >= MIN_CONSISTENCY)
    hides_many = _votes(s, _against, np.ones_like(kept), 1.0) >= MANY_HIDDEN
    return ~kept | (~agreed & (hides_many | _covered(s, agreed)))


def _votes(surfaces: Surfaces, kernel: Callable[..., None], *options: np.ndarray | float) -> np.ndarray:
    """The neighbours' votes for or against each point, as `_support` or `_against` counts them, float32.

    [views, height, width]. options: for `_against`, its `solid` and `same_color`.
    """
    s, votes = surfaces, np.zeros(surfaces.depth.shape, np.float32)
    colors, least, most = s.color_ranges

    def count(view: int) -> None:
        of_view = s.points[view], colors[view], s.neighbors[view]
        kernel(*of_view, s.depth, s.viewmats, s.Ks, least, most, *options, votes[view])

    map_in_threads(count, len(votes))
    return votes


def find_redundant(surfaces: Surfaces, kept: np.ndarray, copies: int) -> np.ndarray:
    """The points of surfaces that `copies` views nearer to the middle show as finely, bool [views, height, width].

    kept: the points that take part, bool [views, height, width]. Copies cost time and memory.
    """
    left, order = kept.copy(), _middle_first(surfaces.extrinsics)
    place = np.argsort(order)
    for view in order.tolist():
        neighbors = surfaces.neighbors[view]
        earlier = neighbors[place[neighbors] < place[view]]
        if len(earlier) >= copies:
            _thin(surfaces.points[view], earlier, surfaces.depth, surfaces.viewmats, surfaces.Ks, left, view, copies)
    return kept & ~left


def _middle_first(extrinsics: np.ndarray) -> np.ndarray:
    """The views by the sum of their distances to the others, smallest first."""
    positions = extrinsics[:, :3, 3]
    return np.argsort(np.linalg.norm(positions[:, None] - positions, axis=-1).sum(axis=1), kind="stable")


def _covered(surfaces: Surfaces, kept: np.ndarray) -> np.ndarray:
    """The pixels of each view that kept points of its neighbours fall on, bool [views, height, width].

    Gaps of a pixel between such points count as covered.
    """
    s, covered = surfaces, np.zeros(kept.shape, np.uint8)

    def cover(view: int) -> None:
        for neighbor in s.neighbors[view]:
            _mark(s.points[neighbor], kept[neighbor], s.viewmats[view], s.Ks[view], covered[view])
        covered[view] = cv2.morphologyEx(covered[view], cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))

    map_in_threads(cover, len(kept))
    return covered > 0


@compiled()
def _mark(points: np.ndarray, kept: np.ndarray, viewmat: np.ndarray, K: np.ndarray, covered: np.ndarray) -> None:
    """Set the pixels of a view [height, width] that the kept points [height, width, 3] of another one fall on."""
    height, width = covered.shape
    for row in range(height):
        for column in range(width):
            if kept[row, column]:
                _, y, x = project_to_pixel(points[row, column], viewmat, K, height, width)
                if y >= 0:
                    covered[y, x] = 1


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
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y >= 0 and abs(z - depth[view, y, x]) <= DEPTH_TOLERANCE * depth[view, y, x]:
                    count += color_agrees(colors[row, column], least[view, y, x], most[view, y, x])
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
    same_color: float,
    against: np.ndarray,  # [height, width]
) -> None:
    """Count the neighbours that see a solid surface behind each point of a view, or of another colour at its place.

    A surface behind it of the point's own colour counts `same_color`.
    """
    height, width = against.shape
    for row in range(height):
        for column in range(width):
            votes = 0.0
            for view in neighbors:
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not solid[view, y, x] or z >= depth[view, y, x] * (1 + DEPTH_TOLERANCE):
                    continue
                if not color_agrees(colors[row, column], least[view, y, x], most[view, y, x]):
                    votes += 1
                elif z < depth[view, y, x] * (1 - DEPTH_TOLERANCE):
                    votes += same_color
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
    copies: int,
) -> None:
    """Clear the points of the view `own` of which `copies` earlier views have a point left, about as finely sampled."""
    height, width = points.shape[:2]
    for row in range(height):
        for column in range(width):
            found = 0
            for view in earlier:
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or not left[view, y, x] or z > COARSER * depth[own, row, column]:
                    continue
                found += abs(z - depth[view, y, x]) <= DEPTH_TOLERANCE * depth[view, y, x]
            if found >= copies:
                left[own, row, column] = False
