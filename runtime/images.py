"""Photographs: found, read upright as RGB, undistorted, and brought to the network's size with their intrinsics."""

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path, PurePath

import cv2
import numpy as np

from .cameras import Camera
from .errors import InputError
from .files import check_regular, read_bytes
from .image_header import HEIF, DamagedImage, ImageHeader, opened, read_header
from .video import SUFFIXES as VIDEO_SUFFIXES

# Images that are read.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp", ".jp2", ".avif", ".ppm", ".pgm"),
    *(".heic", ".heif", ".hif"),
)
# Images that are not: of a folder, they are named as left out.
UNREAD_SUFFIXES = (
    *(".gif", ".jxl", ".jxr", ".jpf", ".j2k", ".exr", ".hdr", ".psd", ".tga", ".svg", ".pbm", ".pnm", ".insp"),
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw"),
    *(".3fr", ".iiq", ".x3f"),
)
LARGEST_FILE = 1 << 31  # bytes
NAMED = 3  # files that a note names
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
    return sorted({os.path.abspath(path): path for path in reversed(found)}.values(), key=_natural)


def stem(path: PurePath) -> str:
    """The name without an image's suffix; `r_0.5` has none."""
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


def unread_images(given: Sequence[str | Path]) -> list[Path]:
    """The images of formats that are not read, by their suffix, that given folders and globs hold, sorted."""
    found = [path for item in given for path in _files_of(item) if _is_unread(path)]
    return sorted(set(found), key=_natural)


def describe_unread(given: Sequence[str | Path]) -> list[str]:
    """A line that names what `unread_images` finds; none where it finds nothing."""
    left = unread_images(given)
    if not left:
        return []
    names = ", ".join(path.name for path in left[:NAMED]) + (", ..." if len(left) > NAMED else "")
    count = "1 image is" if len(left) == 1 else f"{len(left)} images are"
    return [f"{count} of a format that is not read, and left out: {names}; save as JPEG or PNG"]


def load_image(path: Path) -> np.ndarray:
    """Read an image as uint8 RGB, [height, width, 3], turned as its EXIF tag says; it is decoded once.

    Grey becomes RGB, transparency is laid on white, 16 bits are scaled to 8.
    Raises DamagedImage if it cannot be read, InputError if it has more pixels than the limit, which the header tells,
    or holds floating-point values.
    """
    try:
        content = read_bytes(path, "an image", LARGEST_FILE)
    except InputError as error:
        raise DamagedImage(path, str(error).removeprefix(f"{path}: ")) from None
    header = read_header(path, BytesIO(content))
    decoded = _decode(path, content, header)
    if decoded is None:
        raise DamagedImage(path, "is damaged or not an image that is read; save it as JPEG or PNG")
    image = _eight_bits(decoded, path)
    if image.shape[:2] != (header.height, header.width):
        shape = f"{image.shape[1]} x {image.shape[0]}"
        raise DamagedImage(path, f"is damaged: its header says {header.width} x {header.height} pixels, it has {shape}")
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    rgb = image[..., 2::-1]
    if image.shape[2] == 4:
        rgb = _on_white(rgb, image[..., 3])
    return np.ascontiguousarray(_upright(rgb, header.orientation))


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
    """The images one argument stands for."""
    path = Path(item)
    expected = f"expected {', '.join(SUFFIXES)}"
    files = _files_of(item)
    if path.exists() and not path.is_dir():
        check_regular(path)
    if path.is_file() and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: not an image by its suffix; {expected}, or one video ({', '.join(VIDEO_SUFFIXES)})")
    if not files and not path.is_dir():
        raise InputError(f"{item}: no such file or folder, nor a pattern that matches one; expected images")
    images = [file for file in files if _is_image(file)]
    if not images:
        where = "no images in this folder" if path.is_dir() else "matches no images"
        others = f", but {sum(map(_is_unread, files))} of formats that are not read" * any(map(_is_unread, files))
        raise InputError(f"{item}: {where}{others}; {expected}")
    return images


def _files_of(item: str | Path) -> list[Path]:
    """The paths one argument stands for; a name that exists is never taken for a glob."""
    path = Path(item)
    if path.is_dir():
        return list(path.iterdir())
    return [path] if path.is_file() else [Path(name) for name in glob.glob(str(item), recursive=True)]


def _is_image(path: Path) -> bool:
    # macOS leaves ._name.jpg beside name.jpg
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _is_unread(path: Path) -> bool:
    return path.suffix.lower() in UNREAD_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Sort key in which digits count as numbers: text and numbers alternate, so that like is compared with like."""
    pieces = re.split(r"(\d+)", path.as_posix().casefold())
    return [int(piece) if index % 2 else piece for index, piece in enumerate(pieces)], path.as_posix()


def _decode(path: Path, content: bytes, header: ImageHeader) -> np.ndarray | None:
    """The pixels as they are stored, BGR or BGRA or grey, or None where they cannot be decoded."""
    if header.format == HEIF:
        with opened(path, BytesIO(content)) as image:
            mode = "RGBA" if header.transparent else "RGB"
            pixels = np.asarray(image.convert(mode))
        return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if header.transparent else cv2.COLOR_RGB2BGR)
    # Without transparency OpenCV is asked for colours, since it leaves some of TIFF's colour spaces as they are.
    colours = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        flags = cv2.IMREAD_UNCHANGED if header.transparent else colours
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


def _upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """The image [height, width, 3] turned as an EXIF orientation says: mirrored for 2, 4, 5 and 7."""
    if orientation in (5, 6, 7, 8):
        image = image.transpose(1, 0, 2)
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return image[::rows, ::columns]


def _eight_bits(image: np.ndarray, path: Path) -> np.ndarray:
    if image.dtype == np.uint16:
        return cv2.convertScaleAbs(image, alpha=1 / 257)  # 65535 / 255; rounds
    if image.dtype != np.uint8:
        raise InputError(f"{path}: holds {image.dtype} values, expected 8 or 16 bits a channel; save it as PNG")
    return image


def _on_white(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    opacity = alpha[..., None].astype(np.float32) / 255
    return np.rint(rgb * opacity + 255 * (1 - opacity)).astype(np.uint8)
