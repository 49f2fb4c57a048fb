"""Image headers: format, size and orientation, read without decoding, so that sizes are checked before allocation."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from ..errors import InputError
from ..system.files import open_regular
from ..system.limits import IMAGE_MEGAPIXELS

# The formats that are read, by Pillow's names, whatever the suffix.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "JPEG2000", "AVIF", "PPM", "HEIF")
HEIF = "HEIF"
TIFF = "TIFF"
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
BIG_TIFF_HEADER, TIFF_HEADER = 16, 8  # bytes
START = 16  # bytes that identify the format
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
# Tags of TIFF 6.0, and of EXIF 2.32.
TIFF_WIDTH, TIFF_HEIGHT, TIFF_PHOTOMETRIC, TIFF_SAMPLES, ORIENTATION = 256, 257, 262, 277, 274
PHOTOMETRIC_RGB = 2
UPRIGHT = 1
TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
TRANSPARENT_MODES = ("RGBA", "LA", "PA", "La", "RGBa")

logging.getLogger("PIL").addHandler(logging.NullHandler())  # otherwise it writes to stderr


class DamagedImage(InputError):
    """An image that cannot be read. path: the file."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}")
        self.path = path


@dataclass(frozen=True)
class ImageHeader:
    """format: Pillow's name, or TIFF. width, height: as stored, before `orientation` (EXIF) is applied."""

    format: str
    width: int
    height: int
    orientation: int
    transparent: bool

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, upright."""
        swapped = self.orientation in TRANSPOSED
        return (self.height, self.width) if swapped else (self.width, self.height)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, upright, from its header. Raises InputError as `read_header`."""
    path = Path(path)
    try:
        file = open_regular(path)
    except InputError as error:  # a named pipe, say
        raise DamagedImage(path, str(error).removeprefix(f"{path}: ")) from None
    except OSError as error:
        raise DamagedImage(path, f"cannot be read ({error.strerror}); expected an image") from None
    try:
        with file:
            return read_header(path, file).size
    except OSError as error:
        raise DamagedImage(path, f"cannot be read ({error.strerror}); expected an image") from None


def read_header(path: Path, file: BinaryIO) -> ImageHeader:
    """The header of the image in `file`, which is at its beginning; the path is for messages.

    Raises DamagedImage if it is not an image of a supported format, InputError if it has more pixels than the limit.
    """
    start = file.read(START)
    file.seek(0)
    if start.startswith(TIFF_STARTS):
        header = _read_tiff(path, file)
    else:
        with open_image(path, file) as image:
            transparent = image.mode in TRANSPARENT_MODES or "transparency" in image.info
            header = ImageHeader(str(image.format), *image.size, _orientation(image), transparent)
    _check_pixels(path, header.width, header.height)
    return header


@contextmanager
def open_image(path: Path, file: BinaryIO) -> Iterator[Image.Image]:
    """Open the image in `file` with Pillow, not decoded, without Pillow's warnings and size limit.

    Raises DamagedImage, also for errors inside the block.
    """
    start = file.read(START)
    file.seek(0)
    if start[4:8] == b"ftyp" and start[8:12] in HEIF_BRANDS:
        _register_heif(path)
    allowed = Image.MAX_IMAGE_PIXELS
    try:
        Image.MAX_IMAGE_PIXELS = None  # `check_megapixels` applies our own limit
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(file, formats=FORMATS) as image:
                yield image
    except InputError:
        raise
    except Exception as error:  # Pillow raises many types for damaged files
        if isinstance(error, MemoryError):
            raise
        raise DamagedImage(path, "is damaged or not a supported image; save it as JPEG or PNG") from None
    finally:
        Image.MAX_IMAGE_PIXELS = allowed


def read_exif(image: Image.Image) -> Image.Exif:
    """The EXIF data of an image, or empty; unlike `getexif`, without XMP and without decoding."""
    if image.format == TIFF:
        return image.getexif()
    exif, content = Image.Exif(), image.info.get("exif")
    if isinstance(content, bytes):
        exif.load(content)
    return exif


def check_megapixels(what: str, width: int, height: int) -> None:
    """Raise InputError, beginning with `what`, if an image of this size has more pixels than the limit."""
    if width * height > IMAGE_MEGAPIXELS.value * 10**6:
        raise InputError(
            f"{what}: has {width} x {height} pixels, expected {IMAGE_MEGAPIXELS.value} megapixels at most; "
            f"make it smaller, or {IMAGE_MEGAPIXELS.remedy}"
        )


def _check_pixels(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise DamagedImage(path, f"has {width} x {height} pixels, expected an image")
    check_megapixels(str(path), width, height)


def _orientation(image: Image.Image) -> int:
    """The EXIF orientation, 1 to 8; 1 if it is missing or invalid."""
    if image.format == HEIF:  # libheif applies the orientation itself
        return UPRIGHT
    try:
        value = read_exif(image).get(ORIENTATION, UPRIGHT)
    except Exception:  # damaged metadata; the pixels may be valid
        return UPRIGHT
    return value if isinstance(value, int) and 1 <= value <= 8 else UPRIGHT


def _read_tiff(path: Path, file: BinaryIO) -> ImageHeader:
    """The header of a TIFF's first image, from its tags, since Pillow rejects pixel types that OpenCV reads.

    OpenCV applies the orientation of a TIFF itself.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            start = file.read(TIFF_HEADER)
            if start[2:4] in (b"+\0", b"\0+"):
                start += file.read(BIG_TIFF_HEADER - TIFF_HEADER)
            directory = ImageFileDirectory_v2(start)
            file.seek(directory.next)
            directory.load(file)
            width, height = int(directory[TIFF_WIDTH]), int(directory[TIFF_HEIGHT])
            transparent = directory.get(TIFF_PHOTOMETRIC) == PHOTOMETRIC_RGB and directory.get(TIFF_SAMPLES) == 4
            if directory.get(ORIENTATION) in TRANSPOSED:
                width, height = height, width
    except Exception:  # Pillow raises many types for damaged files
        raise DamagedImage(path, "is a damaged TIFF; save it as JPEG or PNG") from None
    return ImageHeader(TIFF, width, height, UPRIGHT, transparent)


def _register_heif(path: Path) -> None:
    try:
        from pi_heif import register_heif_opener
    except ImportError:
        remedy = "pip install pi-heif, or save it as JPEG"
        raise InputError(f"{path}: is a HEIC image, for which pi-heif is needed; {remedy}") from None
    register_heif_opener(thumbnails=False)
