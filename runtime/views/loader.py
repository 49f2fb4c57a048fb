"""Images with cameras, each read and decoded once: what the network takes of it, and a sample to find features in."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from ..cameras.camera import Camera, resize_camera
from ..cameras.undistortion import undistort
from ..errors import error_context
from ..images.io import load_image
from ..images.resizing import resize_and_crop
from ..sfm.features import Features, extract_features

ImageCameraPair = tuple[
    Path | np.ndarray, Camera
]  # an image, as a file or as uint8 RGB [height, width, 3], and its camera

SAMPLE_SIDE = 640  # pixels of the longer side of the copy in which features are looked for


class FeatureImage:
    """A small copy of an image without distortion, in which features are looked for, once and when first asked for.

    camera: the copy's, without distortion.
    """

    def __init__(self, image: np.ndarray, camera: Camera) -> None:
        factor = min(1, SAMPLE_SIDE / max(image.shape[:2]))
        width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        small, self.camera = undistort(small, resize_camera(camera, width, height))
        self._grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)

    @cached_property
    def features(self) -> Features:
        """What SIFT finds, in pixels of the copy."""
        return extract_features(self._grey)


@dataclass(frozen=True, eq=False)
class LoadedView:
    """One image as the network takes it.

    image: float32 RGB in [0, 1], [3, height, width]. intrinsics: normalised, float32 [3, 3].
    camera: undistorted, at the image's full size.
    sample: None where no features are looked for.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    camera: Camera
    sample: FeatureImage | None


class ViewLoader:
    """Reads images with cameras when they are first asked for, and keeps what the network takes of them.

    height, width: the network's. Images are brought to it as `images.fit` says. Samples are taken unless all cameras
    know the depths that they see, for which features are looked for.
    """

    def __init__(self, pairs: Sequence[ImageCameraPair], height: int, width: int) -> None:
        self.pairs, self.height, self.width = pairs, height, width
        self._sampled = any(camera.depth_range is None for _, camera in pairs)
        self._loaded: dict[int, LoadedView] = {}

    def load(self, index: int) -> LoadedView:
        """One of the pairs; raises InputError where it cannot be read, or has another size than its camera."""
        if index not in self._loaded:
            self._loaded[index] = load_view(self.pairs[index], self.height, self.width, self._sampled)
        return self._loaded[index]

    def sample(self, index: int) -> FeatureImage:
        """The sample of one of the pairs, where one is taken; raises as `load`."""
        sample = self.load(index).sample
        assert sample is not None, "features are looked for where depths are not known"
        return sample


def load_view(pair: ImageCameraPair, height: int, width: int, sampled: bool = False) -> LoadedView:
    """Read one image, undistort it and bring it to height x width.

    Raises InputError where it cannot be read or has another size than its camera.
    """
    given, camera = pair
    image = given if isinstance(given, np.ndarray) else load_image(given)
    with error_context(camera.name):
        camera = resize_camera(camera, image.shape[1], image.shape[0])
    sample = FeatureImage(image, camera) if sampled else None
    image, camera = undistort(image, camera)
    return LoadedView(*resize_and_crop(image, camera.K, height, width), camera, sample)
