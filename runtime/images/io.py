"""Reading image files as upright 8-bit RGB."""

from io import BytesIO
from pathlib import Path

import cv2
import numpy as np

from ..errors import InputError
from ..system.files import read_bytes
from .header import HEIF, DamagedImage, ImageHeader, open_image, read_header

MAX_FILE_SIZE = 1 << 31  # bytes


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
