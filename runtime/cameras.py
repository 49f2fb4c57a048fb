"""Cameras: one convention inside, and every convention outside converted here, at the door.

Inside, a pose is camera-to-world with OpenCV axes (x right, y down, z forward) and K is in pixels with the centre of
the top left pixel at (.5, .5). To read another format, add one function that returns `Camera`s and one branch in
`read_cameras`; `Camera` itself checks what every format can get wrong.

This project's own file holds the inside convention as it is, one object for each camera:

    {"format": "idesplat-cameras", "version": 1, "cameras": [
      {"image": "images/0001.jpg", "width": 1080, "height": 1920,
       "fx": 1375.5, "fy": 1374.5, "cx": 554.6, "cy": 965.3,     pixels, pixel centres at .5
       "distortion": [k1, k2, p1, p2],                           OpenCV's model; null or absent for a pinhole
       "extrinsics": [[...], [...], [...], [0, 0, 0, 1]]}]}      camera-to-world, OpenCV axes
"""

import json
import math
import os
import reprlib
from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from .errors import InputError
from .files import replacing

FORMAT = "idesplat-cameras"
VERSION = 1

# transforms.json: perspective models whose coefficients are k1, k2, p1, p2 or fewer of them.
PERSPECTIVE_MODELS = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"}
OTHER_DISTORTION = ("k3", "k4", "k5", "k6")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

RIGID_TOLERANCE = 1e-3  # how far a rotation's singular values may be from 1
RIGID_ROUNDING = 1e-12  # below this a rotation is left as it is, so that what we write is read back unchanged
FARTHEST = 1e9  # a coordinate beyond this is a mistake, and float32 could not place a scene around it
SHORTEST_FOCAL, LONGEST_FOCAL = 0.05, 100.0  # in image widths (heights): 169 and 0.6 degrees of view
NARROWEST_VIEW = 0.001  # radians
LARGEST_SIDE = 1_000_000  # pixels


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated picture.

    name: the image's path as the camera file writes it, such as `images/0001.jpg`.
    width, height: the picture's size in pixels, upright.
    K: float64, pixels, pixel centres at .5, no skew, [3, 3].
    extrinsics: float64, camera-to-world, OpenCV axes (x right, y down, z forward), world units, [4, 4].
    distortion: (k1, k2, p1, p2) of OpenCV's model, or None where there is none.

    Raises InputError if a value is not finite or not plausible, or the pose is not rigid.
    A rotation that is off by rounding only (1e-3) is made orthonormal.
    """

    name: str
    width: int
    height: int
    K: np.ndarray
    extrinsics: np.ndarray
    distortion: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if not (0 < self.width <= LARGEST_SIDE and 0 < self.height <= LARGEST_SIDE):
            size = f"{self.width:.6g} x {self.height:.6g}"
            raise InputError(f"the image's size is {size}, expected 1 to {LARGEST_SIDE} pixels")
        check_intrinsics(self.K, self.width, self.height)
        if self.distortion is not None and not np.isfinite(self.distortion).all():
            raise InputError(f"distortion is {self.distortion}, expected four finite numbers")
        object.__setattr__(self, "extrinsics", rigid(self.extrinsics))


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` (a file, a frame, a field) in front of the message of an InputError raised inside the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def read_cameras(path: Path) -> list[Camera]:
    """Read a file of cameras; its content, not its name, tells the format.

    Known are nerfstudio's and instant-ngp's transforms.json (OpenGL axes, converted) and this project's own
    (see the top of this file). Where a transforms.json has no `w` and `h`, the images are looked for beside it.
    Raises InputError naming the file, the frame and the field.
    """
    path = Path(path)
    with located(str(path)):
        document = _read_json(path)
        if document.get("format") == FORMAT:
            cameras = _from_own(document)
        elif "frames" in document:
            cameras = _from_transforms(document, path.parent)
        else:
            raise InputError(f'no cameras here: expected a transforms.json with "frames", or "format": "{FORMAT}"')
        _check_names(cameras)
    return cameras


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write this project's own file; `read_cameras` gives exactly the same numbers back.

    Raises InputError if the folder cannot be written.
    """
    lines = ",\n".join(json.dumps(_to_own(camera)) for camera in cameras)
    with replacing(path) as temporary:
        temporary.write_text(f'{{"format": "{FORMAT}", "version": {VERSION}, "cameras": [\n{lines}\n]}}\n')


def resized(camera: Camera, width: int, height: int) -> Camera:
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


def rigid(pose: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] as float64 with an orthonormal rotation.

    Raises InputError if it is not finite, or scaled, sheared or mirrored by more than rounding (1e-3).
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape != (4, 4):
        raise InputError(f"the pose has shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise InputError("the pose holds NaN or infinity, expected finite numbers")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise InputError(f"the pose's last row is {_shown(pose[3].tolist())}, expected [0, 0, 0, 1]")
    if np.abs(pose[:3, 3]).max() > FARTHEST:
        raise InputError(
            f"the camera stands at {_shown(pose[:3, 3].tolist())}, expected coordinates below {FARTHEST:g}"
        )
    u, singular, vt = np.linalg.svd(pose[:3, :3])
    error = np.abs(singular - 1).max()
    if error > RIGID_TOLERANCE:
        scales = ", ".join(f"{value:g}" for value in singular)
        kind = "cannot be inverted" if singular[2] < RIGID_TOLERANCE else "is scaled or sheared"
        raise InputError(f"the pose's rotation {kind}: singular values {scales}, expected 1, 1, 1")
    if np.linalg.det(u @ vt) < 0:
        raise InputError("the pose's rotation is mirrored: determinant -1, expected 1; check the axes' convention")
    if error > RIGID_ROUNDING:
        pose = pose.copy()
        pose[:3, :3] = u @ vt
    return pose


def check_intrinsics(K: np.ndarray, width: float, height: float) -> None:
    """Check K [3, 3] of an image of this size (1 by 1 for a normalised K); raises InputError."""
    if K.shape != (3, 3):
        raise InputError(f"K has shape {K.shape}, expected (3, 3)")
    if not np.isfinite(K).all():
        raise InputError("K holds NaN or infinity, expected finite numbers")
    if K[0, 1] != 0 or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise InputError(f"K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: no skew")
    image = f"an image of {width} x {height}"
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if min(fx, fy) <= 0:
        raise InputError(f"the focal lengths are {fx:g} and {fy:g}, expected positive ones")
    if min(fx / width, fy / height) < SHORTEST_FOCAL or max(fx / width, fy / height) > LONGEST_FOCAL:
        raise InputError(f"the focal lengths {fx:g} and {fy:g} are not plausible for {image}; check their unit")
    if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise InputError(f"the principal point ({cx:g}, {cy:g}) lies far outside {image}; check its unit")


# ---- this project's own format


def _from_own(document: dict[str, Any]) -> list[Camera]:
    if document.get("version") != VERSION:
        raise InputError(f"version is {_shown(document.get('version'))}, expected {VERSION}; update idesplat")
    cameras = []
    for index, entry in enumerate(_entries(document, "cameras")):
        with located(f"cameras[{index}]"):
            name = _text(entry, "image")
        with located(f"cameras[{index}] ({name})"):
            width, height = _pixels(entry, "width"), _pixels(entry, "height")
            K = _calibration(*(_number(entry, field) for field in ("fx", "fy", "cx", "cy")))
            distortion = _four(entry["distortion"]) if entry.get("distortion") is not None else None
            cameras.append(Camera(name, width, height, K, _pose(entry, "extrinsics"), distortion))
    return cameras


def _to_own(camera: Camera) -> dict[str, Any]:
    return {
        "image": camera.name,
        "width": camera.width,
        "height": camera.height,
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "distortion": None if camera.distortion is None else list(camera.distortion),
        "extrinsics": camera.extrinsics.tolist(),
    }


def _four(values: object) -> tuple[float, float, float, float]:
    if not isinstance(values, list) or len(values) != 4:
        raise InputError(f"distortion is {_shown(values)}, expected null or [k1, k2, p1, p2]")
    k1, k2, p1, p2 = (_finite(value, "distortion") for value in values)
    return k1, k2, p1, p2


# ---- transforms.json of nerfstudio and instant-ngp


def _from_transforms(document: dict[str, Any], folder: Path) -> list[Camera]:
    cameras: list[Camera] = []
    shared_size: tuple[int, int] | None = None
    for index, frame in enumerate(_entries(document, "frames")):
        with located(f"frames[{index}]"):
            name = _text(frame, "file_path")
        with located(f"frames[{index}] ({name})"):
            settings = ChainMap(frame, document)  # a frame's own values go before those of all
            _check_perspective(settings)
            if "w" in settings or "h" in settings:
                size = _pixels(settings, "w"), _pixels(settings, "h")
            elif any(field in frame for field in INTRINSICS):
                size = _size_beside(folder, name)
            else:  # intrinsics that are shared imply a size that is: one image is enough to know it
                size = shared_size = shared_size or _size_beside(folder, name)
            extrinsics = _pose(frame, "transform_matrix") @ OPENGL_TO_OPENCV
            K = _transforms_calibration(settings, *size)
            cameras.append(Camera(name, *size, K, extrinsics, _transforms_distortion(settings)))
    return cameras


def _check_perspective(settings: Mapping[str, Any]) -> None:
    model = settings.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in PERSPECTIVE_MODELS:
        expected = ", ".join(sorted(PERSPECTIVE_MODELS))
        raise InputError(f"camera_model is {_shown(model)}, expected one of {expected}; undistort the images first")
    if settings.get("is_fisheye", False) is not False:
        raise InputError("is_fisheye is set, expected a perspective camera; undistort the images first")
    for field in OTHER_DISTORTION:
        if field in settings and _number(settings, field) != 0:
            raise InputError(f"{field} is {settings[field]}, expected only k1, k2, p1, p2; undistort the images first")
    if "distortion_params" in settings:
        raise InputError("distortion_params is not read; write k1, k2, p1, p2, or undistort the images first")


def _transforms_calibration(settings: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    if "fl_x" in settings:
        fx = _number(settings, "fl_x")
    elif "camera_angle_x" in settings:
        fx = _focal(settings, "camera_angle_x", width)
    else:
        raise InputError("fl_x is missing, and camera_angle_x too; expected one of them")
    if "fl_y" in settings:
        fy = _number(settings, "fl_y")
    elif "fl_x" not in settings and "camera_angle_y" in settings:
        fy = _focal(settings, "camera_angle_y", height)
    else:
        fy = fx
    cx = _number(settings, "cx") if "cx" in settings else width / 2
    cy = _number(settings, "cy") if "cy" in settings else height / 2
    return _calibration(fx, fy, cx, cy)


def _focal(settings: Mapping[str, Any], field: str, size: int) -> float:
    """Focal length in pixels of a field of view in radians."""
    angle = _number(settings, field)
    if not NARROWEST_VIEW < angle < math.pi:
        raise InputError(f"{field} is {angle:g}, expected radians between {NARROWEST_VIEW} and pi")
    return 0.5 * size / math.tan(0.5 * angle)


def _transforms_distortion(settings: Mapping[str, Any]) -> tuple[float, float, float, float] | None:
    k1, k2, p1, p2 = (_number(settings, field) if field in settings else 0.0 for field in ("k1", "k2", "p1", "p2"))
    return (k1, k2, p1, p2) if any((k1, k2, p1, p2)) else None


def _size_beside(folder: Path, name: str) -> tuple[int, int]:
    """Width and height of the image that a frame names, looked for beside the camera file."""
    from .images import SUFFIXES, load_image  # only here: images.py builds on Camera

    wanted = os.path.join(folder, name.replace("\\", "/"))
    for candidate in (wanted, *(wanted + suffix for suffix in SUFFIXES)):
        if os.path.isfile(candidate):
            height, width = load_image(Path(candidate)).shape[:2]
            return width, height
    raise InputError(f"w and h are missing, and there is no image {wanted} to take them from; add w and h")


# ---- JSON, checked


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror}); expected a file of cameras") from None
    except RecursionError:
        raise InputError("is not a file of cameras: JSON nested too deeply") from None
    except ValueError as error:  # not JSON, not UTF-8, or a number with thousands of digits
        raise InputError(f"is not valid JSON ({error}); expected a file of cameras") from None
    if not isinstance(document, dict):
        raise InputError(f"holds {_shown(document)}, expected a JSON object with cameras")
    return document


def _entries(document: dict[str, Any], field: str) -> list[dict[str, Any]]:
    entries = document.get(field)
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{field} is {_shown(entries)}, expected a list of objects, at least one")
    return entries


def _text(entry: Mapping[str, Any], field: str) -> str:
    value = entry.get(field)
    if not isinstance(value, str) or not PurePosixPath(value).name:
        raise InputError(f"{field} is {_shown(value)}, expected the path of an image")
    return value


def _number(entry: Mapping[str, Any], field: str) -> float:
    if field not in entry:
        raise InputError(f"{field} is missing, expected a number")
    return _finite(entry[field], field)


def _finite(value: object, field: str) -> float:
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise InputError(f"{field} is {_shown(value)}, expected a finite number")


def _pixels(entry: Mapping[str, Any], field: str) -> int:
    value = _number(entry, field)
    if value <= 0 or value != int(value):
        raise InputError(f"{field} is {value:g}, expected a positive whole number of pixels")
    return int(value)


def _pose(entry: Mapping[str, Any], field: str) -> np.ndarray:
    rows = entry.get(field)
    if not (isinstance(rows, list) and len(rows) == 4 and all(isinstance(row, list) and len(row) == 4 for row in rows)):
        raise InputError(f"{field} is {_shown(rows)}, expected the camera's pose as 4 rows of 4 numbers")
    with located(field):
        return rigid(np.array([[_finite(value, f"row {i}") for value in row] for i, row in enumerate(rows)]))


def _calibration(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])  # [3, 3]


def _check_names(cameras: Sequence[Camera]) -> None:
    seen: set[PurePosixPath] = set()
    for index, camera in enumerate(cameras):
        if PurePosixPath(camera.name) in seen:
            raise InputError(
                f"camera {index} names the image {camera.name} a second time, expected one camera for each"
            )
        seen.add(PurePosixPath(camera.name))


def _shown(value: object) -> str:
    """A value for a message, shortened."""
    return "missing" if value is None else reprlib.repr(value)
