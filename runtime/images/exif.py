"""The focal length of a photograph in pixels: as the user gives it, or from its EXIF data."""

import math
import re
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..system.files import open_regular

# The diagonal of 35 mm film, to which cameras relate the focal length that they note (CIPA DCG-001).
FILM_DIAGONAL_MM = float(np.hypot(36, 24))
EXIF_DIRECTORY, FOCAL_LENGTH_35MM = 0x8769, 0xA405
GIVEN = re.compile(r"(\d+(?:\.\d+)?)\s*(mm)?")


def parse_focal(text: str, width: int, height: int) -> float:
    """The option --focal in pixels of a picture of this size: pixels (`1375`), or millimetres on 35 mm film (`26mm`).

    Raises InputError.
    """
    found = GIVEN.fullmatch(text.strip())
    if not found or not 0 < float(found[1]) < math.inf:
        raise InputError(
            f"--focal {text}: expected pixels, such as 1375, or what a lens is on 35 mm film, such as 26mm"
        )
    return _in_pixels(float(found[1]), width, height) if found[2] else float(found[1])


def exif_focal(path: Path, width: int, height: int) -> float | None:
    """The focal length in pixels that a photograph's EXIF data tells; None where it tells none.

    It is the one that the camera relates to 35 mm film, which holds for any size that the picture was scaled to.
    """
    from .header import open_image, read_exif

    try:
        with open_regular(path) as file, open_image(path, file) as image:
            value = read_exif(image).get_ifd(EXIF_DIRECTORY).get(FOCAL_LENGTH_35MM)
        focal_mm = float(value) if value is not None else 0.0
    except Exception:  # of damaged metadata Pillow makes many kinds; the picture itself is read elsewhere
        return None
    return _in_pixels(focal_mm, width, height) if 0 < focal_mm < np.inf else None


def _in_pixels(focal_mm: float, width: int, height: int) -> float:
    """A focal length on 35 mm film in pixels of a picture of this size."""
    return focal_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height))
