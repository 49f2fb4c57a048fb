"""transforms.json of nerfstudio, instant-ngp and NeRF's synthetic scenes: camera-to-world poses with OpenGL axes.

Intrinsics are fields of the document, for all frames, or of a frame, which take precedence: `fl_x fl_y cx cy`, or
`camera_angle_x` in radians; `w h`, or else the size of the images beside the file. `camera_model` defines the
distortion: k1 k2 p1 p2 k3 as in OpenCV, or for OPENCV_FISHEYE (instant-ngp: `is_fisheye`) k1 k2 k3 k4 of cv2.fisheye.
"""

import json
import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import intrinsic_matrix
from ...system.files import atomic_write
from ..camera import Camera
from ..image_files import ImageSizes
from ..parsing import entries, image_name, number, pixels, pose, read_json, short_repr
from ..source import CameraSource

if TYPE_CHECKING:
    from ..image_files import ImageSizes

DESCRIPTION = "transforms.json"
FILE_NAME = "transforms.json"
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
FISHEYE_MODEL = "OPENCV_FISHEYE"
PERSPECTIVE_MODELS = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"}
PERSPECTIVE_FIELDS = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order
FISHEYE_FIELDS = ("k1", "k2", "k3", "k4")
DISTORTION_FIELDS = {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
MIN_FIELD_OF_VIEW = 0.001  # radians


def detect(source: CameraSource) -> bool:
    """Whether a JSON file has frames, or a folder holds a transforms.json."""
    return (source.path / FILE_NAME).is_file() if source.is_folder else "frames" in source.document


def input_files(path: Path) -> list[Path]:
    """The transforms.json of a folder."""
    return [path / FILE_NAME] if path.is_dir() else []


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file. images: give the sizes that are missing in it. Raises InputError."""
    path = path / FILE_NAME if path.is_dir() else path
    document = read_json(path)
    sizes = _Sizes(path.parent, images)
    cameras: list[Camera] = []
    shared_size: tuple[int, int] | None = None
    for index, frame in enumerate(entries(document, "frames")):
        with error_context(f"frames[{index}]"):
            name = image_name(frame, "file_path")
        with error_context(f"frames[{index}] ({name})"):
            settings = ChainMap(frame, document)  # a frame's fields take precedence
            if "w" in settings or "h" in settings:
                size = pixels(settings, "w"), pixels(settings, "h")
            elif any(field in frame for field in INTRINSICS):
                size = sizes.size(name)
            else:  # shared intrinsics imply one size, which any image tells
                size = shared_size = shared_size or sizes.size(name)
            fisheye = _is_fisheye(settings)
            distortion = _distortion(settings, fisheye)
            extrinsics = pose(frame, "transform_matrix") @ OPENGL_TO_OPENCV
            cameras.append(Camera(name, *size, _calibration(settings, *size), extrinsics, distortion, fisheye))
    return cameras


def check_writable(cameras: Sequence[Camera]) -> None:
    """Raise InputError if a camera has more distortion coefficients than the format allows."""
    for camera in cameras:
        _frame(camera)


def write(path: Path, cameras: Sequence[Camera]) -> None:
    """Write a transforms.json with intrinsics in every frame.

    Raises InputError if a camera has more distortion coefficients than the format allows, or the folder is not
    writable.
    """
    frames = [_frame(camera) for camera in cameras]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({"frames": frames}, indent=1) + "\n")


def _is_fisheye(settings: Mapping[str, Any]) -> bool:
    model = settings.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in PERSPECTIVE_MODELS | {FISHEYE_MODEL}:
        expected = ", ".join(sorted(PERSPECTIVE_MODELS | {FISHEYE_MODEL}))
        raise InputError(f"camera_model is {short_repr(model)}, expected one of {expected}; undistort the images first")
    flag = settings.get("is_fisheye", False)
    if not isinstance(flag, bool):
        raise InputError(f"is_fisheye is {short_repr(flag)}, expected true or false")
    if "distortion_params" in settings:
        raise InputError("distortion_params is not read; write k1, k2, p1, p2, or undistort the images first")
    return flag or model == FISHEYE_MODEL


def _distortion(settings: Mapping[str, Any], fisheye: bool) -> tuple[float, ...] | None:
    fields = FISHEYE_FIELDS if fisheye else PERSPECTIVE_FIELDS
    for field in sorted(DISTORTION_FIELDS - set(fields)):
        if field in settings and number(settings, field) != 0:
            kind = "a fisheye lens" if fisheye else "a perspective lens"
            known = ", ".join(fields)
            raise InputError(
                f"{field} is {settings[field]:g}, expected only {known} for {kind}; undistort the images first"
            )
    values = tuple(number(settings, field) if field in settings else 0.0 for field in fields)
    if fisheye:
        return values  # also if all are zero: a fisheye lens is not a pinhole
    if not any(values):
        return None
    return values if values[-1] else values[:-1]


def _calibration(settings: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    if "fl_x" in settings:
        fx = number(settings, "fl_x")
    elif "camera_angle_x" in settings:
        fx = _focal(settings, "camera_angle_x", width)
    else:
        raise InputError("fl_x is missing, and camera_angle_x too; expected one of them")
    if "fl_y" in settings:
        fy = number(settings, "fl_y")
    elif "fl_x" not in settings and "camera_angle_y" in settings:
        fy = _focal(settings, "camera_angle_y", height)
    else:
        fy = fx
    cx = number(settings, "cx") if "cx" in settings else width / 2
    cy = number(settings, "cy") if "cy" in settings else height / 2
    return intrinsic_matrix(fx, fy, cx, cy)


def _focal(settings: Mapping[str, Any], field: str, size: int) -> float:
    """The focal length in pixels for the field of view in a field: f = size / (2 tan(angle / 2))."""
    angle = number(settings, field)
    if not MIN_FIELD_OF_VIEW < angle < math.pi:
        raise InputError(f"{field} is {angle:g}, expected radians between {MIN_FIELD_OF_VIEW} and pi")
    return 0.5 * size / math.tan(0.5 * angle)


class _Sizes:
    """Sizes of images that the file does not store."""

    def __init__(self, folder: Path, images: Sequence[Path]) -> None:
        self.folder, self.images = folder, images

    @cached_property
    def _found(self) -> "ImageSizes":
        return ImageSizes(self.folder, self.images)

    def size(self, name: str) -> tuple[int, int]:
        size = self._found.size(name)
        if size is None:
            image = self.folder / name
            raise InputError(f"w and h are missing, and there is no image {image} that tells them; add w and h")
        return size


def _frame(camera: Camera) -> dict[str, Any]:
    fields = FISHEYE_FIELDS if camera.fisheye else PERSPECTIVE_FIELDS
    coefficients = camera.distortion or ()
    if any(coefficients[len(fields) :]):
        raise InputError(
            f"{camera.name}: has {len(coefficients)} distortion coefficients, a transforms.json can hold "
            f"{', '.join(fields)}; choose a file name other than {FILE_NAME} to write this project's own format"
        )
    return {
        "file_path": camera.name,
        "camera_model": FISHEYE_MODEL if camera.fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.K[0, 0],
        "fl_y": camera.K[1, 1],
        "cx": camera.K[0, 2],
        "cy": camera.K[1, 2],
        **dict(zip(fields, coefficients, strict=False)),
        "transform_matrix": (camera.extrinsics @ OPENGL_TO_OPENCV).tolist(),
    }
