"""Undistortion: resampling an image to a pinhole camera with the same K."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..geometry.intrinsics import to_opencv_pixels
from .camera import Camera, resize_camera


@dataclass(frozen=True, eq=False)
class UndistortedImage:
    """An image of a pinhole camera: uint8 RGB [height, width, 3], and the pixels that the lens saw, [height, width]."""

    image: np.ndarray
    camera: Camera
    valid: np.ndarray


def undistorted_copy(image: np.ndarray, camera: Camera, max_side: int) -> UndistortedImage:
    """A copy of an image of the camera's size, its longer side at most `max_side` pixels, without distortion."""
    image, camera = shrink(image, camera, max_side)
    return UndistortedImage(*undistort(image, camera), undistortion_valid_mask(camera))


def shrink(image: np.ndarray, camera: Camera, max_side: int) -> tuple[np.ndarray, Camera]:
    """The image [height, width, 3] with its longer side at most `max_side` pixels, and the camera of that size."""
    factor = min(1, max_side / max(image.shape[:2]))
    width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), resize_camera(camera, width, height)


def undistort(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """The image resampled to a pinhole camera with the same K, and that camera.

    image: [height, width, 3] of the camera's size. Pixels outside the input image repeat its border.
    """
    if camera.distortion is None:
        return image, camera
    map_x, map_y = _undistortion_maps(camera)
    undistorted = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return undistorted, replace(camera, distortion=None, fisheye=False)


def undistortion_valid_mask(camera: Camera) -> np.ndarray:
    """The pixels that `undistort` takes from inside the input image: bool [height, width]."""
    if camera.distortion is None:
        return np.ones((camera.height, camera.width), bool)
    map_x, map_y = _undistortion_maps(camera)
    return (map_x >= 0) & (map_x <= camera.width - 1) & (map_y >= 0) & (map_y <= camera.height - 1)


def _undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Input coordinates x and y of each undistorted pixel, in OpenCV's pixels: float32 [height, width] each."""
    K = to_opencv_pixels(camera.K)
    size = camera.width, camera.height
    lens = cv2.fisheye if camera.fisheye else cv2
    return lens.initUndistortRectifyMap(K, np.array(camera.distortion), np.eye(3), K, size, cv2.CV_32FC1)
