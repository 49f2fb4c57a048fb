"""Photographs: found, read upright as RGB, undistorted, and brought to the network's size with their intrinsics."""

import glob
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

import cv2
import numpy as np

from .cameras import Camera
from .errors import InputError

# Still pictures that OpenCV reads.
SUFFIXES = (".jpg", ".jpeg", ".jpe", ".png", ".webp", ".tif", ".tiff", ".bmp", ".jp2", ".avif", ".ppm", ".pgm")
JPEG_START = b"\xff\xd8"
HALF_PIXEL = 0.5  # OpenCV's geometry puts pixel centres at whole numbers, ours at .5


@dataclass(frozen=True)
class Crop:
    """How a picture was brought to another size: scaled to width x height, then cut from (left, top)."""

    scale_x: float
    scale_y: float
    width: int
    height: int
    left: int
    top: int

    @property
    def matrix(self) -> np.ndarray:
        """Maps pixel coordinates (x, y, 1) of the original to those of the result, [3, 3]; its inverse leads back."""
        return np.array([[self.scale_x, 0, -self.left], [0, self.scale_y, -self.top], [0, 0, 1]])


def find_images(given: Sequence[str | Path]) -> list[Path]:
    """Return the images that folders, globs and files stand for, each once, sorted naturally (img2 before img10).

    Raises InputError if something given does not exist or is no image, or nothing is found.
    """
    found = [path for item in given for path in _images_of(item)]
    if not found:
        raise InputError(f"no images given; expected a folder, a glob or files ending in {', '.join(SUFFIXES)}")
    return sorted(set(found), key=_natural)


def stem(path: PurePath) -> str:
    """The name without an image's suffix; `r_0.5` has none."""
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


def load_image(path: Path) -> np.ndarray:
    """Read an image as uint8 RGB, [height, width, 3], turned as its EXIF tag says.

    Grey becomes RGB, transparency is laid on white, 16 bits are scaled to 8.
    Raises InputError if it cannot be read or holds floating-point values.
    """
    try:
        content = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    image = _decode(content, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise InputError(f"{path}: is damaged or not an image that OpenCV reads; save it as JPEG or PNG")
    rgb = _eight_bits(image, path)[..., ::-1]
    if content[:2].tobytes() != JPEG_START:  # a JPEG has no transparency
        stored = _decode(content, cv2.IMREAD_UNCHANGED)
        if stored is not None and stored.ndim == 3 and stored.shape[2] == 4:
            if not np.array_equal(stored[..., :3], image):  # only this flag leaves the EXIF rotation out
                raise InputError(f"{path}: has transparency and an EXIF rotation; save it with one of them only")
            rgb = _on_white(rgb, _eight_bits(stored[..., 3], path))
    return np.ascontiguousarray(rgb)


def undistort(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the picture a pinhole camera with the same K would take, and that camera.

    image: [height, width, 3] of the camera's size. What the lens did not see is filled with the nearest pixel.
    """
    if camera.distortion is None:
        return image, camera
    map_x, map_y = _undistortion_maps(camera)
    straight = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return straight, replace(camera, distortion=None, fisheye=False)


def seen_by_lens(camera: Camera) -> np.ndarray:
    """Where `undistort` shows what the lens saw, and nothing filled in: bool, [height, width]."""
    if camera.distortion is None:
        return np.ones((camera.height, camera.width), bool)
    map_x, map_y = _undistortion_maps(camera)
    return (map_x >= 0) & (map_x <= camera.width - 1) & (map_y >= 0) & (map_y <= camera.height - 1)


def cover(width: int, height: int, target_width: int, target_height: int) -> Crop:
    """Return the scaling that just covers the target size, and the cut from its middle."""
    factor = max(target_width / width, target_height / height)
    # A side is rounded to a whole pixel, so its true scale differs a little from the factor.
    scaled_width = max(target_width, round(width * factor))
    scaled_height = max(target_height, round(height * factor))
    left, top = (scaled_width - target_width) // 2, (scaled_height - target_height) // 2
    return Crop(scaled_width / width, scaled_height / height, scaled_width, scaled_height, left, top)


def fit(image: np.ndarray, K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Scale a picture to cover height x width, cut out the middle, and let the intrinsics follow exactly.

    image: uint8 RGB, [image height, image width, 3]. K: pixels, pixel centres at .5, [3, 3].
    Returns the picture, float32 in [0, 1], [3, height, width], and its intrinsics, float32, [3, 3], with row 0 divided
    by the width and row 1 by the height. `cover` tells where a result lies in the original.
    """
    crop = cover(image.shape[1], image.shape[0], width, height)
    interpolation = cv2.INTER_AREA if crop.scale_x < 1 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, (crop.width, crop.height), interpolation=interpolation)
    cut = scaled[crop.top : crop.top + height, crop.left : crop.left + width]
    pixels = np.ascontiguousarray(cut.transpose(2, 0, 1), dtype=np.float32) / np.float32(255)  # [3, height, width]
    intrinsics = np.diag([1 / width, 1 / height, 1]) @ crop.matrix @ K
    return pixels, intrinsics.astype(np.float32)


def _undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the undistorted picture, where it lies in the photograph, in OpenCV's pixel coordinates."""
    K = camera.K - HALF_PIXEL * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    size = camera.width, camera.height
    lens = cv2.fisheye if camera.fisheye else cv2
    return lens.initUndistortRectifyMap(K, np.array(camera.distortion), np.eye(3), K, size, cv2.CV_32FC1)


def _images_of(item: str | Path) -> list[Path]:
    """The images one argument stands for; a name that exists is never taken for a glob."""
    path = Path(item)
    expected = f"expected {', '.join(SUFFIXES)}"
    if path.is_dir():
        inside = [child for child in path.iterdir() if _is_image(child)]
        if not inside:
            raise InputError(f"{path}: no images in this folder; {expected}")
        return inside
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{path}: not an image by its suffix; {expected}")
        return [path]
    matches = [Path(name) for name in glob.glob(str(item), recursive=True)]
    if not matches:
        raise InputError(f"{item}: no such file or folder, nor a pattern that matches one; expected images")
    images = [match for match in matches if _is_image(match)]
    if not images:
        raise InputError(f"{item}: matches no images; {expected}")
    return images


def _is_image(path: Path) -> bool:
    # macOS leaves ._name.jpg beside name.jpg
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Sort key in which digits count as numbers: text and numbers alternate, so that like is compared with like."""
    pieces = re.split(r"(\d+)", path.as_posix().casefold())
    return [int(piece) if index % 2 else piece for index, piece in enumerate(pieces)], path.as_posix()


def _decode(content: np.ndarray, flags: int) -> np.ndarray | None:
    try:
        return cv2.imdecode(content, flags)
    except cv2.error:
        return None


def _eight_bits(image: np.ndarray, path: Path) -> np.ndarray:
    if image.dtype == np.uint16:
        return cv2.convertScaleAbs(image, alpha=1 / 257)  # 65535 / 255; rounds
    if image.dtype != np.uint8:
        raise InputError(f"{path}: holds {image.dtype} values, expected 8 or 16 bits a channel; save it as PNG")
    return image


def _on_white(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    opacity = alpha[..., None].astype(np.float32) / 255
    return np.rint(rgb * opacity + 255 * (1 - opacity)).astype(np.uint8)
