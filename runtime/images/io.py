"""Finding image files, and reading them as upright 8-bit RGB."""

import glob
import os
import re
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path, PurePath

import cv2
import numpy as np

from ..errors import InputError
from ..system.files import check_regular, read_bytes
from .header import HEIF, DamagedImage, ImageHeader, open_image, read_header
from .video_reader import SUFFIXES as VIDEO_SUFFIXES

# Supported formats.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp", ".jp2", ".avif", ".ppm", ".pgm"),
    *(".heic", ".heif", ".hif"),
)
# Image formats that are not supported, whose files are reported when a folder holds them.
UNSUPPORTED_SUFFIXES = (
    *(".gif", ".jxl", ".jxr", ".jpf", ".j2k", ".exr", ".hdr", ".psd", ".tga", ".svg", ".pbm", ".pnm", ".insp"),
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw"),
    *(".3fr", ".iiq", ".x3f"),
)
MAX_FILE_SIZE = 1 << 31  # bytes
EXAMPLES = 3  # names listed in a message


def find_images(given: Sequence[str | Path]) -> list[Path]:
    """The images in folders, globs and files, without duplicates, in natural order (img2 before img10).

    Raises InputError if an input does not exist or is not an image, or if nothing is found.
    """
    found = [path for item in given for path in _images_of(item)]
    if not found:
        raise InputError(f"no images given; expected a folder, a glob or files ending in {', '.join(SUFFIXES)}")
    return sorted({os.path.abspath(path): path for path in reversed(found)}.values(), key=_natural)


def image_stem(path: PurePath) -> str:
    """The file name without the suffix of an image format; other suffixes, as in `r_0.5`, are kept."""
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


def unsupported_images(given: Sequence[str | Path]) -> list[Path]:
    """Images of unsupported formats, by suffix, in folders and globs, in natural order."""
    found = [path for item in given for path in _files_of(item) if _is_unread(path)]
    return sorted(set(found), key=_natural)


def describe_unsupported(given: Sequence[str | Path]) -> list[str]:
    """A note that names the `unsupported_images`, or none."""
    left = unsupported_images(given)
    if not left:
        return []
    names = ", ".join(path.name for path in left[:EXAMPLES]) + (", ..." if len(left) > EXAMPLES else "")
    count = "1 image is" if len(left) == 1 else f"{len(left)} images are"
    return [f"{count} of an unsupported format, and left out: {names}; save as JPEG or PNG"]


def load_image(path: Path) -> np.ndarray:
    """Read an image as uint8 RGB [height, width, 3], upright by its EXIF orientation.

    Grey becomes RGB, transparency is composited over white, 16 bits are scaled to 8.
    Raises DamagedImage if it cannot be read, InputError if it exceeds the pixel limit or holds floating-point values.
    """
    try:
        content = read_bytes(path, "an image", MAX_FILE_SIZE)
    except InputError as error:
        raise DamagedImage(path, str(error).removeprefix(f"{path}: ")) from None
    header = read_header(path, BytesIO(content))
    decoded = _decode(path, content, header)
    if decoded is None:
        raise DamagedImage(path, "is damaged or not a supported image; save it as JPEG or PNG")
    image = _eight_bits(decoded, path)
    if image.shape[:2] != (header.height, header.width):
        shape = f"{image.shape[1]} x {image.shape[0]}"
        raise DamagedImage(path, f"is damaged: its header says {header.width} x {header.height} pixels, it has {shape}")
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    rgb = image[..., 2::-1]
    if image.shape[2] == 4:
        rgb = _on_white(rgb, image[..., 3])
    return np.ascontiguousarray(_upright(rgb, header.orientation))


def _images_of(item: str | Path) -> list[Path]:
    """The images of one input."""
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
    """The paths of one input; an existing path is never taken for a glob."""
    path = Path(item)
    if path.is_dir():
        return list(path.iterdir())
    return [path] if path.is_file() else [Path(name) for name in glob.glob(str(item), recursive=True)]


def _is_image(path: Path) -> bool:
    # macOS leaves ._name.jpg beside name.jpg
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _is_unread(path: Path) -> bool:
    return path.suffix.lower() in UNSUPPORTED_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _natural(path: Path) -> tuple[list[str | int], str]:
    """The key of natural sorting: text and numbers alternate, so that only values of one type are compared."""
    pieces = re.split(r"(\d+)", path.as_posix().casefold())
    return [int(piece) if index % 2 else piece for index, piece in enumerate(pieces)], path.as_posix()


def _decode(path: Path, content: bytes, header: ImageHeader) -> np.ndarray | None:
    """The pixels as stored, BGR, BGRA or grey, or None if they cannot be decoded."""
    if header.format == HEIF:
        with open_image(path, BytesIO(content)) as image:
            mode = "RGBA" if header.transparent else "RGB"
            pixels = np.asarray(image.convert(mode))
        return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if header.transparent else cv2.COLOR_RGB2BGR)
    # IMREAD_UNCHANGED would not convert some of TIFF's colour spaces, so it is used for transparency only.
    colours = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        flags = cv2.IMREAD_UNCHANGED if header.transparent else colours
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


def _upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """The image [height, width, 3] with an EXIF orientation applied (2, 4, 5 and 7 mirror it)."""
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
