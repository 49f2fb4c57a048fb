"""Points matched between views whose cameras are known; each pair of views is matched once."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..images.colormaps import to_uint8
from ..sfm.features import Features, extract_features, match_features, normalize_points, sampson_distance
from .loader import FeatureImage

MAX_EPIPOLAR_ERROR = 1.5  # pixels


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Normalised image coordinates (X / Z, Y / Z) of the same points in two views.

    first, second: [points, 2] each. second_from_first: transforms points from the first camera's frame to the second's,
    [4, 4].
    """

    first: np.ndarray
    second: np.ndarray
    second_from_first: np.ndarray


def match_along_epipolar_lines(
    first: Features,
    second: Features,
    first_K: np.ndarray,
    second_K: np.ndarray,
    second_from_first: np.ndarray,
    pairs: np.ndarray | None = None,
) -> PointMatches:
    """Matches whose Sampson distance is below `MAX_EPIPOLAR_ERROR`.

    first_K, second_K: in pixels, [3, 3]. second_from_first: as in `PointMatches`. pairs: matches of the features, as
    index pairs [matches, 2]; found here by default.
    """
    pairs = match_features(first, second) if pairs is None else pairs
    a, b = (
        normalize_points(first.keypoints[pairs[:, 0]], first_K),
        normalize_points(second.keypoints[pairs[:, 1]], second_K),
    )
    pixel = 1 / np.sqrt(first_K[0, 0] * second_K[0, 0])
    inliers = sampson_distance(a, b, second_from_first) < MAX_EPIPOLAR_ERROR * pixel
    return PointMatches(a[inliers], b[inliers], second_from_first)


class ViewMatcher:
    """Matches points between views, inside the network's crop of each; remembers what it has matched.

    images: RGB in [0, 1], [views, 3, height, width]. extrinsics: camera-to-world, [views, 4, 4].
    intrinsics: normalised, [views, 3, 3].
    feature_images: one for each view, or none; features are extracted from them instead of the smaller `images`.
    """

    def __init__(
        self,
        images: np.ndarray,
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        feature_images: Sequence[FeatureImage] = (),
    ) -> None:
        self.images, self.extrinsics, self.intrinsics = images, extrinsics, intrinsics
        self._feature_images = feature_images
        self._matches: dict[tuple[int, int], PointMatches] = {}

    def match(self, i: int, j: int, max_features: int | None = None) -> PointMatches:
        """The matches of view `i` with view `j`; of `max_features` features of view `i`, unless all are matched."""
        if (i, j) in self._matches:
            return self._matches[i, j]
        features, K = self._features
        first, pairs = features[i], None
        if max_features is not None and len(first.keypoints) > max_features:
            chosen = np.linspace(0, len(first.keypoints) - 1, max_features).astype(int)
            first = Features(first.keypoints[chosen], first.descriptors[chosen])
        elif self._feature_images:
            pairs = self._feature_images[i].match(self._feature_images[j])
        second_from_first = invert_rigid(self.extrinsics[j]) @ self.extrinsics[i]
        matches = match_along_epipolar_lines(first, features[j], K[i], K[j], second_from_first, pairs)
        if first is features[i]:
            self._matches[i, j] = matches
        return matches

    @cached_property
    def _features(self) -> tuple[list[Features], np.ndarray]:
        """The features of every view, and the intrinsics [views, 3, 3] in the pixels of their keypoints."""
        if self._feature_images:
            features = [feature_image.inside for feature_image in self._feature_images]
            return features, np.stack([feature_image.camera.K for feature_image in self._feature_images])
        height, width = self.images.shape[2:]
        rgb = to_uint8(self.images).transpose(0, 2, 3, 1)
        features = [extract_features(np.ascontiguousarray(image)) for image in rgb]
        return features, denormalize_intrinsics(self.intrinsics, width, height)
