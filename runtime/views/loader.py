"""Loading views: images read once, undistorted, resized to the network's input, with a copy for feature extraction."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ..cameras.camera import Camera, resize_camera
from ..cameras.undistortion import UndistortedImage, shrink, undistort, undistorted_copy
from ..errors import error_context
from ..images.io import load_image
from ..images.resizing import resize_and_crop
from ..sfm.features import Features, extract_features, match_features, normalize_points

ImageCameraPair = tuple[
    Path | np.ndarray, Camera
]  # an image, as a file or as uint8 RGB [height, width, 3], and its camera

FEATURE_SIDE = 640  # pixels: longer side of the copy for feature extraction
REDUCTION = 2  # of the copy that is looked at first where no depth is needed from its features


class FeatureImage:
    """A small undistorted copy of an image, with features and matches, which are computed when first needed.

    camera: of the copy, without distortion. crop: normalised intrinsics [3, 3] of the part that the network sees; the
    whole image by default.
    """

    def __init__(
        self, image: np.ndarray, camera: Camera, crop: np.ndarray | None = None, max_side: int = FEATURE_SIDE
    ) -> None:
        small, self.camera = undistort(*shrink(image, camera, max_side))
        self._grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY) if small.ndim == 3 else small
        self._crop, self._max_side = crop, max_side
        self._matches: dict[FeatureImage, np.ndarray] = {}

    @cached_property
    def features(self) -> Features:
        """SIFT features, in pixels of the copy."""
        return extract_features(self._grey)

    @cached_property
    def inside(self) -> Features:
        """The features inside the crop."""
        if self._crop is None:
            return self.features
        points = normalize_points(self.features.keypoints, self.camera.K)
        position = points * np.diag(self._crop)[:2] + self._crop[:2, 2]  # in the crop, in [0, 1]
        inside = ((position >= 0) & (position <= 1)).all(axis=1)
        return Features(self.features.keypoints[inside], self.features.descriptors[inside])

    @cached_property
    def reduced(self) -> "FeatureImage":
        """The same at a fraction of the size, and of the time for features."""
        return FeatureImage(self._grey, self.camera, self._crop, self._max_side // REDUCTION)

    @cached_property
    def whole(self) -> "FeatureImage":
        """The same without the crop, with features of its own; this image if nothing is cut off."""
        if len(self.inside.keypoints) == len(self.features.keypoints):
            return self
        return FeatureImage(self._grey, self.camera, max_side=self._max_side)

    def match(self, other: "FeatureImage") -> np.ndarray:
        """Matches of the features inside both crops, as index pairs [matches, 2]."""
        if other not in self._matches:
            self._matches[other] = match_features(self.inside, other.inside)
        return self._matches[other]


@dataclass(frozen=True, eq=False)
class LoadedView:
    """One view as the network's input.

    image: float32 RGB in [0, 1], [3, height, width]. intrinsics: normalised, float32 [3, 3].
    camera: undistorted, at the image's full size.
    feature_image: None if no features are needed. copy: at another size, for refinement; None if not needed.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    camera: Camera
    feature_image: FeatureImage | None
    copy: UndistortedImage | None = None


class ViewLoader:
    """Loads views when they are first needed, and keeps them.

    height, width: of the network's input; images are resized by `resize_and_crop`. Feature images are made unless all
    cameras have a depth range, or if `match` asks for them. copy_side: longer side of the copies for refinement, in
    pixels; 0 for none.
    """

    def __init__(
        self, pairs: Sequence[ImageCameraPair], height: int, width: int, match: bool = False, copy_side: int = 0
    ) -> None:
        self.pairs, self.height, self.width, self.copy_side = pairs, height, width, copy_side
        self.needs_depth = any(camera.depth_range is None for _, camera in pairs)
        self._with_features = match or self.needs_depth
        self._loaded: dict[int, LoadedView] = {}

    def name(self, index: int) -> str:
        """The file name of one of the pairs' images, or the name of its camera if it is an array."""
        image, camera = self.pairs[index]
        return image.name if isinstance(image, Path) else camera.name

    def load(self, index: int) -> LoadedView:
        """The view of one of the pairs. Raises InputError as `load_view`."""
        if index not in self._loaded:
            self._loaded[index] = load_view(
                self.pairs[index], self.height, self.width, self._with_features, self.copy_side
            )
        return self._loaded[index]

    def feature_image(self, index: int) -> FeatureImage:
        """The feature image of one of the pairs, if they are made. Raises InputError as `load_view`."""
        feature_image = self.load(index).feature_image
        assert feature_image is not None, "feature images are made where depths or matches are needed"
        return feature_image


def load_view(
    pair: ImageCameraPair, height: int, width: int, with_features: bool = False, copy_side: int = 0
) -> LoadedView:
    """Read one image, undistort it, and resize it to height x width (`resize_and_crop`).

    Raises InputError if it cannot be read, or if its size does not match its camera.
    """
    given, camera = pair
    image = given if isinstance(given, np.ndarray) else load_image(given)
    with error_context(camera.name):
        camera = resize_camera(camera, image.shape[1], image.shape[0])
    copy = undistorted_copy(image, camera, copy_side) if copy_side else None
    undistorted, pinhole = undistort(image, camera)
    pixels, intrinsics = resize_and_crop(undistorted, pinhole.K, height, width)
    feature_image = FeatureImage(image, camera, intrinsics) if with_features else None
    return LoadedView(pixels, intrinsics, pinhole, feature_image, copy)
