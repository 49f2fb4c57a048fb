"""The camera: one calibrated image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..geometry.intrinsics import check_intrinsics
from ..geometry.rigid import check_rigid

DISTORTION_LENGTHS = (4, 5, 8, 12, 14)  # that OpenCV's model may have
FISHEYE_LENGTH = 4


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated picture.

    name: the image's path as the camera file writes it, such as `images/0001.jpg`.
    width, height: the picture's size in pixels, upright.
    K: float64, pixels, pixel centres at .5, no skew, [3, 3].
    extrinsics: float64, camera-to-world, OpenCV axes (x right, y down, z forward), world units, [4, 4].
    distortion: OpenCV's coefficients, k1 k2 p1 p2 and on as it orders them (4, 5, 8, 12 or 14), or None for a pinhole.
    fisheye: the lens is one of cv2.fisheye's, and distortion its k1 k2 k3 k4.
    depth_range: near and far, between which all lies that it sees, in world units; None where that is not known.

    Raises InputError if a value is not finite or not plausible, or the pose is not rigid.
    A rotation that is off by rounding only (1e-3) is made orthonormal.
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
            raise InputError(f"the image's size is {size}, expected 1 to {MAX_SIDE} pixels")
        check_intrinsics(self.K, self.width, self.height)
        _check_distortion(self.distortion, self.fisheye)
        if self.depth_range is not None:
            _check_depth_range(self.depth_range)
        object.__setattr__(self, "extrinsics", check_rigid(self.extrinsics))


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the same picture at another size in pixels.

    Raises InputError if the aspect differs by more than rounding each side to a whole pixel explains.
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
            "the cameras were made for the picture turned by 90 degrees: save the pictures as they were then, "
            "without an EXIF rotation"
            if rotated
            else "give the pictures that the cameras were made for, or the same ones scaled"
        )
        raise InputError(
            f"the image has {width} x {height} pixels, its camera {camera.width} x {camera.height}; {advice}"
        )
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=scale @ camera.K)


def offset_cameras(cameras: Sequence[Camera], offset: np.ndarray) -> list[Camera]:
    """Cameras in a world whose origin is at `offset` [3] of theirs, as that of a scene with an offset is."""
    if not offset.any():
        return list(cameras)
    moved = []
    for camera in cameras:
        extrinsics = camera.extrinsics.copy()
        extrinsics[:3, 3] -= offset
        moved.append(replace(camera, extrinsics=extrinsics))
    return moved


def _check_distortion(distortion: tuple[float, ...] | None, fisheye: bool) -> None:
    if fisheye and (distortion is None or len(distortion) != FISHEYE_LENGTH):
        raise InputError(f"distortion is {distortion}, expected k1, k2, k3, k4 for a fisheye lens")
    if distortion is None:
        return
    if len(distortion) not in DISTORTION_LENGTHS:
        lengths = ", ".join(map(str, DISTORTION_LENGTHS))
        raise InputError(
            f"distortion is {distortion}, expected k1, k2, p1, p2 and on as OpenCV has it: {lengths} numbers"
        )
    if not np.isfinite(distortion).all():
        raise InputError(f"distortion is {distortion}, expected finite numbers")


def _check_depth_range(depth_range: tuple[float, float]) -> None:
    if len(depth_range) != 2 or not np.isfinite(depth_range).all() or not 0 < depth_range[0] < depth_range[1]:
        raise InputError(f"the range of depth is {depth_range}, expected 0 < nearest < farthest")


MAX_SIDE = 1_000_000  # pixels
