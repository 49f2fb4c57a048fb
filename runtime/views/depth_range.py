"""Near and far: from what the cameras are known to see, from points matched between the views, or from the baseline."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.baselines import nearest_neighbor_pairs
from ..geometry.depth_bounds import MIN_POINTS, depth_bounds
from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..sfm.features import (
    Features,
    extract_features,
    match_features,
    normalize_points,
    parallax_angles,
    sampson_distance,
    triangulate,
)
from .loader import FeatureImage
from .selection import PairScorer, guess_scene_depths

SAMPLES = 3  # images looked at to find how far away a scene is, each with two others
EPIPOLAR_ERROR = 1.5  # pixels
SMALLEST_PARALLAX_DEG = 0.3  # below, a triangulated depth is noise


@dataclass(frozen=True)
class DepthRange:
    """near, far: scene units. source: where they come from, in words."""

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
    feature_images: Sequence[FeatureImage] = (),
) -> DepthRange:
    """Near and far of these views; what is given stays.

    feature_images: one for each view, or none; features are extracted from them instead of the smaller `images`.
    Ranges that the cameras know go first, then points matched between the views and triangulated. Where there are too
    few of them, near is the longest distance of a view from its nearest neighbour: what is closer is seen from
    directions so different that nothing would match; far is then as many times near as in `trained`, the near and far
    of the model's training.
    Raises InputError if the result is not 0 < near < far.
    """
    if near is not None and far is not None:
        return _checked(DepthRange(near, far, "given"))
    found = (
        _known(cameras)
        or _matched(images, extrinsics, intrinsics, feature_images)
        or _from_baseline(extrinsics, trained)
    )
    if near is not None:
        found = DepthRange(near, found.far, f"near given, far from {found.source}")
    elif far is not None:
        found = DepthRange(found.near, far, f"far given, near from {found.source}")
    return _checked(found)


def _checked(found: DepthRange) -> DepthRange:
    if not 0 < found.near < found.far:
        raise InputError(
            f"near {found.near:g} and far {found.far:g} ({found.source}): expected 0 < near < far; "
            "give --near and --far, in the unit of the cameras' positions"
        )
    return found


def _known(cameras: Iterable[Camera]) -> DepthRange | None:
    ranges = [camera.depth_range for camera in cameras if camera.depth_range is not None]
    if not ranges:
        return None
    return DepthRange(
        min(near for near, _ in ranges), max(far for _, far in ranges), "what the cameras are known to see"
    )


def _matched(
    images: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray, feature_images: Sequence[FeatureImage]
) -> DepthRange | None:
    if feature_images:
        features = [_inside(sample, normal) for sample, normal in zip(feature_images, intrinsics, strict=True)]
        K = np.stack([sample.camera.K for sample in feature_images])
    else:
        height, width = images.shape[2:]
        pictures = np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8).transpose(0, 2, 3, 1)
        features = [extract_features(np.ascontiguousarray(picture)) for picture in pictures]
        K = denormalize_intrinsics(intrinsics, width, height)  # [views, 3, 3]
    depths = [np.zeros(0)]
    for i, j in nearest_neighbor_pairs(extrinsics):
        depths += triangulated_depths(features[i], features[j], K[i], K[j], invert_rigid(extrinsics[j]) @ extrinsics[i])
    depth = np.concatenate(depths)  # two depths for each point
    found = depth_bounds(depth)
    return found and DepthRange(*found, f"{len(depth) // 2} points matched between the photographs")


def _inside(sample: FeatureImage, intrinsics: np.ndarray) -> Features:
    """The features of a sample that lie in what the network takes of the image; its normalised intrinsics [3, 3]."""
    features = sample.features
    rays = normalize_points(features.keypoints, sample.camera.K)
    normal = rays * np.diag(intrinsics)[:2] + intrinsics[:2, 2]
    inside = ((normal >= 0) & (normal <= 1)).all(axis=1)
    return Features(features.keypoints[inside], features.descriptors[inside])


def triangulated_depths(
    first: Features, second: Features, first_K: np.ndarray, second_K: np.ndarray, second_from_first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depths [points] in the first and in the second view of the points that both see, by their known cameras.

    Ks [3, 3] in pixels. second_from_first: takes points from the first camera's frame to the second's, [4, 4].
    """
    pairs = match_features(first, second)
    a, b = (
        normalize_points(first.keypoints[pairs[:, 0]], first_K),
        normalize_points(second.keypoints[pairs[:, 1]], second_K),
    )
    pixel = 1 / np.sqrt(first_K[0, 0] * second_K[0, 0])
    inliers = sampson_distance(a, b, second_from_first) < EPIPOLAR_ERROR * pixel
    points = triangulate(a[inliers], b[inliers], second_from_first)
    there = points @ second_from_first[:3, :3].T + second_from_first[:3, 3]
    angle = parallax_angles(points, invert_rigid(second_from_first)[:3, 3])
    seen = (points[:, 2] > 0) & (there[:, 2] > 0) & (angle > SMALLEST_PARALLAX_DEG)
    return points[seen, 2], there[seen, 2]


def _from_baseline(extrinsics: np.ndarray, trained: tuple[float, float]) -> DepthRange:
    positions = extrinsics[:, :3, 3]
    baseline = max(float(np.linalg.norm(positions[i] - positions[j])) for i, j in nearest_neighbor_pairs(extrinsics))
    return DepthRange(baseline, baseline * trained[1] / trained[0], "the baseline")


def scene_depths(cameras: Sequence[Camera], sample: Callable[[int], FeatureImage]) -> tuple[np.ndarray, str]:
    """How far from each camera the scene is, [cameras], and how that is known, in words.

    In the middle of the depths that the camera is known to see; where that is not known, at the median depth of points
    matched between a few of the images; where none match, as `guess_scene_depths` has it.
    sample: reads the image of the camera with this index; what it raises is raised.
    """
    distances = guess_scene_depths(cameras)
    unknown = np.array([camera.depth_range is None for camera in cameras])
    if not unknown.any():
        return distances, "what the cameras are known to see"
    depths = np.concatenate([np.zeros(0), *_sampled_depths(cameras, distances, sample)])
    if len(depths) < 2 * MIN_POINTS:
        return distances, "the directions of the cameras"
    return np.where(unknown, np.median(depths), distances), "points matched between a few photographs"


def _sampled_depths(
    cameras: Sequence[Camera], distances: np.ndarray, sample: Callable[[int], FeatureImage]
) -> list[np.ndarray]:
    """Depths of points that a few images share with that of the best partner, and with the next one."""
    scorer, everyone = PairScorer(cameras, distances), np.arange(len(cameras))
    depths: list[np.ndarray] = []
    for i in np.linspace(0, len(cameras) - 1, SAMPLES + 2)[1:-1].round().astype(int).tolist():
        best = int(scorer.score(np.full(len(cameras), i), everyone).cost.argmin())
        for j in (best, min(i + 1, len(cameras) - 1)):
            if i != j:
                first, second = sample(i), sample(j)
                between = invert_rigid(cameras[j].extrinsics) @ cameras[i].extrinsics
                depths += triangulated_depths(first.features, second.features, first.camera.K, second.camera.K, between)
    return depths
