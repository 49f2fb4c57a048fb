"""The camera model: intrinsics, distortion and pose of one image."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry.intrinsics import check_intrinsics, scale_intrinsics
from ..geometry.rigid import check_rigid

DISTORTION_LENGTHS = (4, 5, 8, 12, 14)  # numbers of coefficients in OpenCV's model
FISHEYE_LENGTH = 4
MAX_SIDE = 1_000_000  # pixels


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera of one image.

    name: the image's path as stored in the camera file, such as `images/0001.jpg`.
    width, height: the image size in pixels, upright.
    K: intrinsics in pixels, pixel centres at 0.5, no skew, float64 [3, 3].
    extrinsics: camera-to-world, OpenCV axes (x right, y down, z forward), world units, float64 [4, 4].
    distortion: OpenCV's coefficients k1 k2 p1 p2 k3 ... in its order (4, 5, 8, 12 or 14), or None for a pinhole camera.
    fisheye: the lens model is that of cv2.fisheye, and distortion its k1 k2 k3 k4.
    depth_range: near and far bounds of the visible depth, in world units; None if unknown.

    Raises InputError if a value is not finite or not plausible, or the pose is not rigid. A rotation with rounding
    errors (up to 1e-3) is made orthonormal.
    """

    name: str
    width: int
    height: int
    K: np.ndarray
    extrinsics: np.ndarray
    distortion: tuple[float, ...] | None = None
    fisheye: bool = False
    depth_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            size = f"{self.width:.6g} x {self.height:.6g}"
            raise InputError(f"the image size is {size}, expected 1 to {MAX_SIDE} pixels")
        check_intrinsics(self.K, self.width, self.height)
        _check_distortion(self.distortion, self.fisheye)
        if self.depth_range is not None:
            _check_depth_range(self.depth_range)
        object.__setattr__(self, "extrinsics", check_rigid(self.extrinsics))


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same image resized to width x height pixels.

    Raises InputError if the aspect ratio differs by more than rounding each side to a whole pixel explains.
    """
    if (width, height) == (camera.width, camera.height):
        return camera
    smallest = max((width - 1) / camera.width, (height - 1) / camera.height)
    largest = min((width + 1) / camera.width, (height + 1) / camera.height)
    if smallest > largest:
        rotated = abs(width / height - camera.height / camera.width) < abs(
            width / height - camera.width / camera.height
        )
        advice = (
            "the camera is of the image rotated by 90 degrees: save the image as it was, without an EXIF rotation"
            if rotated
            else "give the images that the cameras were made for, at any scale"
        )
        raise InputError(
            f"the image has {width} x {height} pixels, its camera {camera.width} x {camera.height}; {advice}"
        )
    K = scale_intrinsics(camera.K, width / camera.width, height / camera.height)
    return replace(camera, width=width, height=height, K=K)


def offset_cameras(cameras: Sequence[Camera], offset: np.ndarray) -> list[Camera]:
    """The cameras in a world frame whose origin is at `offset` [3] in the present one."""
    if not offset.any():
        return list(cameras)
    shifted = []
    for camera in cameras:
        extrinsics = camera.extrinsics.copy()
        extrinsics[:3, 3] -= offset
        shifted.append(replace(camera, extrinsics=extrinsics))
    return shifted


def _check_distortion(distortion: tuple[float, ...] | None, fisheye: bool) -> None:
    if fisheye and (distortion is None or len(distortion) != FISHEYE_LENGTH):
        raise InputError(f"distortion is {distortion}, expected k1, k2, k3, k4 for a fisheye lens")
    if distortion is None:
        return
    if len(distortion) not in DISTORTION_LENGTHS:
        lengths = ", ".join(map(str, DISTORTION_LENGTHS))
        raise InputError(
            f"distortion is {distortion}, expected k1, k2, p1, p2, ... in OpenCV's order: {lengths} numbers"
        )
    if not np.isfinite(distortion).all():
        raise InputError(f"distortion is {distortion}, expected finite numbers")


def _check_depth_range(depth_range: tuple[float, float]) -> None:
    if len(depth_range) != 2 or not np.isfinite(depth_range).all() or not 0 < depth_range[0] < depth_range[1]:
        raise InputError(f"the depth range is {depth_range}, expected 0 < near < far")


def named_from(folder: Path, cameras: Sequence[Camera], frames: Path | None = None) -> list[Camera]:
    """The cameras, their images named as seen from a folder, where they are files.

    frames: where frames of a video lie for a while; these keep their name alone.
    """
    named = []
    for camera in cameras:
        if Path(camera.name).parent == frames:
            camera = replace(camera, name=Path(camera.name).name)
        elif Path(camera.name).is_file():
            path = Path(camera.name)  # of a link its own name, by which cameras are matched
            name = os.path.join(os.path.realpath(path.parent), path.name)
            with suppress(ValueError):  # on another drive of Windows
                name = os.path.relpath(name, os.path.realpath(folder))
            camera = replace(camera, name=Path(name).as_posix())
        named.append(camera)
    return named
