"""Survey of a capture's frames: depth, epipolar error, and overlap and baseline of pairs, from matched keypoints."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ....runtime.cameras.camera import Camera, resize_camera
from ....runtime.geometry.baselines import pairwise_baselines
from ....runtime.geometry.rigid import invert_rigid
from ....runtime.images.io import load_image
from ....runtime.sfm.features import match_features, normalize_points, sampson_distance
from ....runtime.system.files import atomic_write
from ....runtime.system.progress import progress
from ....runtime.views.depth_range import scene_depths, triangulated_depths
from ....runtime.views.loader import FeatureImage
from ....runtime.views.selection import score_pairs

MIN_MATCHES = 30
PARTNERS = 3


@dataclass(frozen=True, eq=False)
class Survey:
    """Depth and epipolar error of frames, and overlap and baseline of pairs, from matched keypoints.

    depth: median z-depth in scene units, [frames]. error: median Sampson distance in pixels, [frames].
    overlap: share of the view that both see, [frames, frames]. baseline: over the depth of what both see,
    [frames, frames].
    """

    depth: np.ndarray
    error: np.ndarray
    overlap: np.ndarray
    baseline: np.ndarray


class EpipolarErrors:
    """Median epipolar distance of two frames' matches in pixels, infinite where few match.

    Features are extracted when a frame is first asked for.
    """

    def __init__(self, pairs: Sequence[tuple[Path, Camera]]) -> None:
        self._pairs = pairs
        self._samples: dict[int, FeatureImage] = {}
        self._errors: dict[tuple[int, int], float] = {}

    def __call__(self, first: int, second: int) -> float:
        """The distance for two frames, by index."""
        if (first, second) not in self._errors:
            self._errors[first, second], _ = _epipolar(self._sample(first), self._sample(second))
        return self._errors[first, second]

    def _sample(self, index: int) -> FeatureImage:
        if index not in self._samples:
            self._samples[index] = _sample(*self._pairs[index])
        return self._samples[index]


def cached_survey(path: Path, pairs: Sequence[tuple[Path, Camera]]) -> Survey:
    """The survey of frames, cached in a file."""
    if not path.exists():
        with atomic_write(path) as temporary:
            np.savez(temporary, **vars(_survey(pairs)))
    with np.load(path) as content:
        return Survey(**content)


def _survey(pairs: Sequence[tuple[Path, Camera]]) -> Survey:
    """Match each frame with its best neighbours."""
    cameras = [camera for _, camera in pairs]
    samples = [_sample(*pair) for pair in progress(pairs, "finding features")]
    distances, _ = scene_depths(cameras, samples.__getitem__)
    cost = score_pairs(cameras, distances).cost
    error, depth = np.full(len(pairs), np.inf), np.array(distances, float)
    for i in range(len(pairs)):
        partners = [int(j) for j in np.argsort(cost[i])[:PARTNERS] if np.isfinite(cost[i, j])]
        found = [_epipolar(samples[i], samples[j]) for j in partners]
        error[i] = min((value for value, _ in found), default=np.inf)
        depths = np.concatenate([np.zeros(0), *(values for _, values in found)])
        if len(depths) >= MIN_MATCHES:
            depth[i] = np.median(depths)
    baselines = pairwise_baselines(np.stack([camera.extrinsics for camera in cameras]))
    return Survey(depth, error, score_pairs(cameras, depth).overlap, baselines / np.sqrt(depth[:, None] * depth[None]))


def _sample(path: Path, camera: Camera) -> FeatureImage:
    image = load_image(path)
    return FeatureImage(image, resize_camera(camera, image.shape[1], image.shape[0]))


def _epipolar(first: FeatureImage, second: FeatureImage) -> tuple[float, np.ndarray]:
    """Median epipolar distance of two frames' matches in pixels, and depths in the first frame."""
    a, b, first_camera, second_camera = first.features, second.features, first.camera, second.camera
    matches = match_features(a, b)
    if len(matches) < MIN_MATCHES:
        return np.inf, np.zeros(0)
    between = invert_rigid(second_camera.extrinsics) @ first_camera.extrinsics
    rays = (
        normalize_points(a.keypoints[matches[:, 0]], first_camera.K),
        normalize_points(b.keypoints[matches[:, 1]], second_camera.K),
    )
    focal = np.sqrt(first_camera.K[0, 0] * second_camera.K[0, 0])
    error = float(np.median(sampson_distance(*rays, between)) * focal)
    return error, triangulated_depths(a, b, first_camera.K, second_camera.K, between)[0]
