"""Near and far of the views: from the cameras' depth ranges, from triangulated matches, or from the baseline."""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.baselines import nearest_neighbor_pairs
from ..geometry.depth_bounds import MIN_POINTS, depth_bounds
from ..geometry.rigid import invert_rigid, transform_points
from ..sfm.features import Features, parallax_angles, triangulate
from .loader import FeatureImage
from .matching import PointMatches, ViewMatcher, match_along_epipolar_lines
from .selection import PairScorer, guess_scene_depths

LOG = logging.getLogger(__name__)

BASELINE = "the baseline"  # the source that knows nothing of the scene
SAMPLED_IMAGES = 3  # that are matched, with two others each, for the depth of the scene
MIN_PARALLAX_DEG = 0.3  # with less, a triangulated depth is mostly noise


@dataclass(frozen=True)
class DepthRange:
    """near, far: in scene units. source: where they come from, for the user."""

    near: float
    far: float
    source: str


def estimate_depth_range(
    images: np.ndarray,  # [views, 3, height, width], RGB in [0, 1]
    extrinsics: np.ndarray,  # [views, 4, 4]
    intrinsics: np.ndarray,  # [views, 3, 3], normalised
    cameras: Iterable[Camera],
    trained: tuple[float, float],
    near: float | None = None,
    far: float | None = None,
    matcher: ViewMatcher | None = None,
) -> DepthRange:
    """Estimate near and far of these views; given values are kept.

    matcher: of these views; without one, features are extracted from `images`.
    Sources, in order: the cameras' depth ranges; points that are matched between the views and triangulated; the
    baseline: near is then the longest distance between a view and its nearest neighbour, since closer points have too
    much parallax for matching, and far / near is that of `trained`, the near and far of the model's training.
    Raises InputError if the result is not 0 < near < far.
    """
    if near is not None and far is not None:
        return _checked(DepthRange(near, far, "given"))
    found = (
        _from_cameras(cameras)
        or _from_matches(matcher or ViewMatcher(images, extrinsics, intrinsics))
        or _from_baseline(extrinsics, trained)
    )
    if near is not None:
        found = DepthRange(near, found.far, f"near given, far from {found.source}")
    elif far is not None:
        found = DepthRange(found.near, far, f"far given, near from {found.source}")
    return _checked(found)


def _checked(found: DepthRange) -> DepthRange:
    LOG.info("near %g and far %g: %s", found.near, found.far, found.source)
    if not 0 < found.near < found.far:
        raise InputError(
            f"near {found.near:g} and far {found.far:g} ({found.source}): expected 0 < near < far; "
            "give --near and --far, in the unit of the cameras' positions"
        )
    return found


def _from_cameras(cameras: Iterable[Camera]) -> DepthRange | None:
    ranges = [camera.depth_range for camera in cameras if camera.depth_range is not None]
    if not ranges:
        return None
    return DepthRange(min(near for near, _ in ranges), max(far for _, far in ranges), "the cameras' depth ranges")


def _from_matches(matcher: ViewMatcher) -> DepthRange | None:
    depths = [np.zeros(0)]
    for i, j in nearest_neighbor_pairs(matcher.extrinsics):
        depths += _triangulate(matcher.match(i, j))
    depth = np.concatenate(depths)  # two depths for each point
    found = depth_bounds(depth)
    return found and DepthRange(*found, f"{len(depth) // 2} points matched between the images")


def triangulated_depths(
    first: Features, second: Features, first_K: np.ndarray, second_K: np.ndarray, second_from_first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depths [points] in the first and in the second view of matches that are triangulated with known cameras.

    first_K, second_K: in pixels, [3, 3]. second_from_first: transforms points from the first camera's frame to the
    second's, [4, 4].
    """
    return _triangulate(match_along_epipolar_lines(first, second, first_K, second_K, second_from_first))


def _triangulate(matches: PointMatches) -> tuple[np.ndarray, np.ndarray]:
    """`triangulated_depths` of these matches."""
    points = triangulate(matches.first, matches.second, matches.second_from_first)
    in_second = transform_points(matches.second_from_first, points)
    angle = parallax_angles(points, invert_rigid(matches.second_from_first)[:3, 3])
    valid = (points[:, 2] > 0) & (in_second[:, 2] > 0) & (angle > MIN_PARALLAX_DEG)
    return points[valid, 2], in_second[valid, 2]


def _from_baseline(extrinsics: np.ndarray, trained: tuple[float, float]) -> DepthRange:
    positions = extrinsics[:, :3, 3]
    baseline = max(float(np.linalg.norm(positions[i] - positions[j])) for i, j in nearest_neighbor_pairs(extrinsics))
    return DepthRange(baseline, baseline * trained[1] / trained[0], BASELINE)


def scene_depths(cameras: Sequence[Camera], feature_image: Callable[[int], FeatureImage]) -> tuple[np.ndarray, str]:
    """The depth of the scene in each camera, [cameras], and its source, for the user.

    From the camera's depth range; without one, the median depth of points matched between a few images; without
    matches, from `guess_scene_depths`.
    feature_image: loads the image of the camera with this index.
    """
    guesses = guess_scene_depths(cameras)
    unknown = np.array([camera.depth_range is None for camera in cameras])
    if not unknown.any():
        return guesses, "the cameras' depth ranges"
    depths = np.concatenate([np.zeros(0), *_sampled_depths(cameras, guesses, feature_image)])
    if len(depths) < 2 * MIN_POINTS:
        return guesses, "the directions of the cameras"
    return np.where(unknown, np.median(depths), guesses), "points matched between a few images"


def _sampled_depths(
    cameras: Sequence[Camera], guesses: np.ndarray, feature_image: Callable[[int], FeatureImage]
) -> list[np.ndarray]:
    """Depths of points matched between a few images and two others each: the best partner, and the next image."""
    scorer, indices = PairScorer(cameras, guesses), np.arange(len(cameras))
    depths: list[np.ndarray] = []
    for i in np.linspace(0, len(cameras) - 1, SAMPLED_IMAGES + 2)[1:-1].round().astype(int).tolist():
        best = int(scorer.score(np.full(len(cameras), i), indices).cost.argmin())
        for j in (best, min(i + 1, len(cameras) - 1)):
            if i != j:
                first, second = feature_image(i), feature_image(j)
                second_from_first = invert_rigid(cameras[j].extrinsics) @ cameras[i].extrinsics
                depths += triangulated_depths(
                    first.features, second.features, first.camera.K, second.camera.K, second_from_first
                )
    return depths
