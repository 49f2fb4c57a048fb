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
from ..sfm.features import Features, extract_features

ImageCameraPair = tuple[
    Path | np.ndarray, Camera
]  # an image, as a file or as uint8 RGB [height, width, 3], and its camera

FEATURE_SIDE = 640  # pixels: longer side of the copy for feature extraction


class FeatureImage:
    """A small undistorted copy of an image, and its features, which are extracted when first needed.

    camera: of the copy, without distortion.
    """

    def __init__(self, image: np.ndarray, camera: Camera) -> None:
        small, self.camera = undistort(*shrink(image, camera, FEATURE_SIDE))
        self._grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)

    @cached_property
    def features(self) -> Features:
        """SIFT features, in pixels of the copy."""
        return extract_features(self._grey)


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
    cameras have a depth range. copy_side: longer side of the copies for refinement, in pixels; 0 for none.
    """

    def __init__(self, pairs: Sequence[ImageCameraPair], height: int, width: int, copy_side: int = 0) -> None:
        self.pairs, self.height, self.width, self.copy_side = pairs, height, width, copy_side
        self._with_features = any(camera.depth_range is None for _, camera in pairs)
        self._loaded: dict[int, LoadedView] = {}

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
        assert feature_image is not None, "feature images are made unless all depth ranges are known"
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
    feature_image = FeatureImage(image, camera) if with_features else None
    copy = undistorted_copy(image, camera, copy_side) if copy_side else None
    image, camera = undistort(image, camera)
    return LoadedView(*resize_and_crop(image, camera.K, height, width), camera, feature_image, copy)
