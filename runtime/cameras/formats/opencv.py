"""OpenCV stereo calibrations, YAML or XML of cv2.FileStorage: K and distortion of two cameras, and R and T.

R and T are as in cv2.stereoCalibrate: x2 = R x1 + T, with points x1 and x2 in the frames of the first and the second
camera. The first camera's frame is the world. OpenCV's pixel centres are at integers, so 0.5 is added to the principal
points. Of a calibration in two files, intrinsics.yml and extrinsics.yml as OpenCV's sample writes them, either can be
given. The file stores no image names: two images are given, left and right, which also give the size if it is missing.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, error_context, one_line
from ...geometry.intrinsics import from_opencv_pixels
from ...geometry.rigid import invert_rigid
from ...images.header import image_size
from ...system.files import read_bytes
from ..camera import Camera
from ..image_files import GIVE_IMAGES
from ..parsing import EXPECTED, MAX_FILE_SIZE
from ..source import CameraSource

DESCRIPTION = "OpenCV's stereo calibration"
# Field names in OpenCV's documentation, samples and forums.
MATRIX = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix_{}", "camera_matrix{}", "CM{}")
DISTORTION = ("D{}", "distCoeffs{}", "dist_coeffs_{}", "dist_coeffs{}", "distortion_coefficients_{}")
ROTATION = ("R", "rotation", "Rotation", "rotation_matrix")
TRANSLATION = ("T", "translation", "Translation", "translation_vector")
SIZE = ("imageSize", "image_size", "img_size", "size")
WIDTH, HEIGHT = ("image_width", "imageWidth", "width"), ("image_height", "imageHeight", "height")
OTHER_FILE = {"intrinsics": "extrinsics", "extrinsics": "intrinsics"}
NAMES = ("left", "right")


def detect(source: CameraSource) -> bool:
    """Whether a file is YAML with a directive or XML, as cv2.FileStorage writes them."""
    return source.start.startswith((b"%YAML", b"<?xml", b"<opencv_storage"))


def input_files(path: Path) -> list[Path]:
    """The other file of a calibration in two files."""
    return [path.with_stem(OTHER_FILE[path.stem])] if path.stem in OTHER_FILE else []


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file. images: the left and the right one, in this order. Raises InputError."""
    if images and len(images) != len(NAMES):
        raise InputError(f"calibrates two cameras, but {len(images)} images are given; give the left and the right one")
    fields = _fields(path)
    other = path.with_stem(OTHER_FILE.get(path.stem, path.stem))
    if other != path and other.is_file():
        with error_context(other.name):
            fields = {**_fields(other), **fields}
    pose = np.eye(4)
    pose[:3, :3] = _rotation(_matrix(fields, ROTATION))
    pose[:3, 3] = _matrix(fields, TRANSLATION, (3,))
    cameras = []
    for index, extrinsics in enumerate((np.eye(4), invert_rigid(pose))):
        name = images[index].name if images else NAMES[index]
        with error_context(f"camera {index + 1}"):
            size = _size(fields, images[index : index + 1])
            cameras.append(_camera(fields, index + 1, name, size, extrinsics))
    return cameras


def _camera(fields: dict[str, Any], number: int, name: str, size: tuple[int, int], extrinsics: np.ndarray) -> Camera:
    K = from_opencv_pixels(_matrix(fields, [form.format(number) for form in MATRIX], (3, 3)))
    forms = [form.format(number) for form in DISTORTION]
    values = _matrix(fields, forms).ravel().tolist() if any(form in fields for form in forms) else []
    return Camera(name, *size, K, extrinsics, tuple(values) if any(values) else None)


def _fields(path: Path) -> dict[str, Any]:
    """The top-level fields of the file: numbers, text and matrices (float64)."""
    import cv2

    text = read_bytes(path, EXPECTED, MAX_FILE_SIZE).decode("utf-8", errors="replace")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {name: _value(root.getNode(name)) for name in list(root.keys())}
    except (cv2.error, SystemError, ValueError) as error:
        raise InputError(f"OpenCV cannot read this calibration ({one_line(error)}); is it damaged?") from None


def _value(node: Any) -> Any:
    """A node of cv2.FileStorage as a number, text, matrix or list of numbers; None for other types."""
    if node.isReal() or node.isInt():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        return _stored_matrix(node)
    return _numbers(node)


def _stored_matrix(node: Any) -> np.ndarray | None:
    """A matrix of cv2.FileStorage, float64 [rows, cols]; None for anything else.

    `node.mat()` would write past its memory where rows and cols do not fit the data.
    """
    rows, cols, values = node.getNode("rows"), node.getNode("cols"), _numbers(node.getNode("data"))
    if values is None or not (rows.isInt() and cols.isInt()):
        return None
    shape = int(rows.real()), int(cols.real())
    return values.reshape(shape) if min(shape) > 0 and shape[0] * shape[1] == values.size else None


def _numbers(node: Any) -> np.ndarray | None:
    """A sequence of numbers, float64; None for anything else."""
    if not node.isSeq():
        return None
    items = [node.at(index) for index in range(node.size())]
    return np.array([item.real() for item in items]) if all(item.isReal() or item.isInt() for item in items) else None


def _matrix(fields: dict[str, Any], names: Sequence[str], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """The first of these fields that exists, reshaped to `shape` if given. Raises InputError."""
    name = next((name for name in names if name in fields), None)
    if name is None:
        raise InputError(
            f"{names[0]} is missing (or {', '.join(names[1:])}); give the file that holds it, or one file with both"
        )
    value = fields[name]
    if not isinstance(value, np.ndarray) or (shape and value.size != np.prod(shape)):
        expected = " x ".join(map(str, shape or ("numbers",)))
        found = f"of shape {value.shape}" if isinstance(value, np.ndarray) else repr(value)
        raise InputError(f"{name} is {found}, expected a matrix of {expected}")
    if not np.isfinite(value).all():
        raise InputError(f"{name} holds NaN or infinity, expected finite numbers")
    return value.reshape(shape) if shape else value


def _rotation(value: np.ndarray) -> np.ndarray:
    """A rotation matrix [3, 3], from a matrix or a rotation vector (axis times angle)."""
    import cv2

    if value.size == 3:
        return cv2.Rodrigues(value.ravel())[0]
    if value.shape != (3, 3):
        raise InputError(f"R has shape {value.shape}, expected 3 x 3")
    return value


def _size(fields: dict[str, Any], images: Sequence[Path]) -> tuple[int, int]:
    """Width and height, from the file or from the first of the images."""
    size = next((fields[name] for name in SIZE if name in fields), None)
    if isinstance(size, np.ndarray) and size.size == 2:
        width, height = size.ravel().tolist()
    else:
        width, height = (next((fields[name] for name in names if name in fields), None) for names in (WIDTH, HEIGHT))
    if isinstance(width, float) and isinstance(height, float):
        if not (width.is_integer() and height.is_integer()):
            raise InputError(f"the image's size is {width:g} x {height:g}, expected whole pixels")
        return int(width), int(height)

    if not images:
        raise InputError(f"has no {SIZE[0]}, and no image is given that tells it; {GIVE_IMAGES}")
    return image_size(images[0])
