"""Undistortion: the image that a pinhole camera would have taken."""

from dataclasses import replace

import cv2
import numpy as np

from ..images.io import HALF_PIXEL
from .camera import Camera


def undistort(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the picture a pinhole camera with the same K would take, and that camera.

    image: [height, width, 3] of the camera's size. What the lens did not see is filled with the nearest pixel.
    """
    if camera.distortion is None:
        return image, camera
    map_x, map_y = _undistortion_maps(camera)
    straight = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return straight, replace(camera, distortion=None, fisheye=False)


def undistortion_valid_mask(camera: Camera) -> np.ndarray:
    """Where `undistort` shows what the lens saw, and nothing filled in: bool, [height, width]."""
    if camera.distortion is None:
        return np.ones((camera.height, camera.width), bool)
    map_x, map_y = _undistortion_maps(camera)
    return (map_x >= 0) & (map_x <= camera.width - 1) & (map_y >= 0) & (map_y <= camera.height - 1)


def _undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the undistorted picture, where it lies in the photograph, in OpenCV's pixel coordinates."""
    K = camera.K - HALF_PIXEL * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    size = camera.width, camera.height
    lens = cv2.fisheye if camera.fisheye else cv2
    return lens.initUndistortRectifyMap(K, np.array(camera.distortion), np.eye(3), K, size, cv2.CV_32FC1)
