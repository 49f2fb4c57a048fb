"""Views that contradict each other although all fit their cameras: part of the scene was moved between the photographs.

Cameras follow what most matched points lie on. If an object was turned on its table, they follow the object: the points
matched between a view before and one after it lie on the object alone, and fit. But they are spread over much less of
the image than those that a view has in common with others. Views that no points all over their images link show
different states of the scene.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.consistency import project_to_view
from ..geometry.intrinsics import normalize_intrinsics
from ..geometry.rigid import invert_rigid, transform_points
from ..sfm.features import triangulate
from .loader import FeatureImage
from .matching import match_along_epipolar_lines

CELLS = 16  # along an image's longer side; points in one cell count once
MIN_POINTS, MIN_CELLS = 20, 8  # of a pair, and expected of it, to tell anything
# The validation captures have spreads of 0.5 and more between views of one state, and of 0.36 and less across states.
# Beyond the parallax few points of slanted surfaces are matched, so that a small spread says nothing.
MIN_SPREAD, MAX_PARALLAX_DEG = 0.43, 12.0


@dataclass(frozen=True)
class Contradiction:
    """A pair of views, by their indices, that show two states of the scene, and the spread of their points."""

    view: int
    other: int
    spread: float


@dataclass(frozen=True, eq=False)
class _Common:
    """What a view has in common with another: places in its image, normalised, [points, 2], and points [points, 3]."""

    rays: np.ndarray
    points: np.ndarray


def find_contradictions(
    images: Sequence[FeatureImage], parallax: Mapping[tuple[int, int], float]
) -> dict[int, Contradiction]:
    """The views that show another state of the scene than most, each with a pair that shows it.

    The pair is one of the view's own, if it has any, else that of a view of the same state.
    parallax: in degrees, of pairs of overlapping images by their indices.
    """
    common = _match(images, parallax)
    linked, apart = np.eye(len(images), dtype=bool), []
    for (first, second), angle in parallax.items():
        both = (_spread(images, common, *pair) for pair in ((first, second), (second, first)))
        spreads = [spread for spread in both if spread is not None]
        if spreads and min(spreads) >= MIN_SPREAD:
            linked[first, second] = linked[second, first] = True
        elif spreads and angle <= MAX_PARALLAX_DEG:
            apart += [Contradiction(first, second, min(spreads)), Contradiction(second, first, min(spreads))]
    states = _components(linked)
    majority, size = max(Counter(states.tolist()).items(), key=lambda state: state[1])
    if size == 1:
        return {}
    against = sorted((pair for pair in apart if states[pair.other] == majority), key=lambda pair: pair.spread)
    found = {}
    for view, state in enumerate(states.tolist()):
        shown = [pair for pair in against if states[pair.view] == state != majority]
        if shown:
            found[view] = next((pair for pair in shown if pair.view == view), shown[0])
    return found


def _match(images: Sequence[FeatureImage], pairs: Iterable[tuple[int, int]]) -> dict[int, dict[int, _Common]]:
    """What each view has in common with others, by their indices."""
    common: dict[int, dict[int, _Common]] = defaultdict(dict)
    for view, other in pairs:
        a, b = images[view], images[other]
        b_from_a = invert_rigid(b.camera.extrinsics) @ a.camera.extrinsics
        matches = match_along_epipolar_lines(a.inside, b.inside, a.camera.K, b.camera.K, b_from_a, a.match(b))
        if len(matches.first) >= MIN_POINTS:
            points = transform_points(a.camera.extrinsics, triangulate(matches.first, matches.second, b_from_a))
            common[view][other] = _Common(matches.first, points)
            common[other][view] = _Common(matches.second, points)
    return common


def _spread(
    images: Sequence[FeatureImage], common: dict[int, dict[int, _Common]], view: int, other: int
) -> float | None:
    """How far the points of a pair are spread in the first view, relative to those expected there.

    Expected are the points that the view has in common with others, and that lie in the second view's image. None if
    there are not enough to tell.
    """
    if other not in common[view]:
        return None
    expected: set[tuple[int, int]] = set()
    for third, part in common[view].items():
        if third != other:
            expected |= _cells(images[view], part.rays[_visible(part.points, images[other])])
    area = _area(expected)
    if len(expected) < MIN_CELLS or area == 0:
        return None
    return _area(_cells(images[view], common[view][other].rays)) / area


def _cells(image: FeatureImage, rays: np.ndarray) -> set[tuple[int, int]]:
    """The cells of an image that places in it lie in. rays: normalised, [points, 2]."""
    side = max(image.camera.width, image.camera.height) / CELLS
    pixels = rays * np.diag(image.camera.K)[:2] + image.camera.K[:2, 2]
    return {(column, row) for column, row in (pixels // side).astype(int).tolist()}


def _visible(points: np.ndarray, image: FeatureImage) -> np.ndarray:
    """Which points [points, 3] lie in an image, bool [points]."""
    camera = image.camera
    intrinsics = normalize_intrinsics(camera.K, camera.width, camera.height)
    return project_to_view(points, (camera.height, camera.width), camera.extrinsics, intrinsics)[2]


def _area(cells: set[tuple[int, int]]) -> float:
    """The area that cells are spread over, up to a factor: that of the ellipse of their covariance; 0 on a line."""
    if len(cells) <= 2:
        return 0.0
    return float(np.sqrt(max(np.linalg.det(np.cov(np.array(sorted(cells), float).T)), 0)))


def _components(linked: np.ndarray) -> np.ndarray:
    """The connected component that each of the nodes is in, by its first node, [nodes]. linked: bool [nodes, nodes]."""
    component = np.arange(len(linked))
    while True:
        lowest = np.where(linked, component, len(linked)).min(axis=1)
        if (lowest == component).all():
            return component
        component = lowest
