"""The focal length of an image in pixels: from the option --focal, or from EXIF data."""

import math
import re
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..system.files import open_regular
from .header import open_image, read_exif

# EXIF's FocalLengthIn35mmFilm is relative to the diagonal of 35 mm film (CIPA DCG-001).
FILM_DIAGONAL_MM = float(np.hypot(36, 24))
EXIF_DIRECTORY, FOCAL_LENGTH_35MM = 0x8769, 0xA405
GIVEN = re.compile(r"(\d+(?:\.\d+)?)\s*(mm)?")


def parse_focal(text: str, width: int, height: int) -> float:
    """The option --focal in pixels, for an image of this size: pixels (`1375`), or equivalent to 35 mm film (`26mm`).

    Raises InputError.
    """
    found = GIVEN.fullmatch(text.strip())
    if not found or not 0 < float(found[1]) < math.inf:
        raise InputError(f"--focal {text}: expected pixels, such as 1375, or the 35 mm equivalent, such as 26mm")
    return _in_pixels(float(found[1]), width, height) if found[2] else float(found[1])


def exif_focal(path: Path, width: int, height: int) -> float | None:
    """The focal length in pixels from EXIF data, for an image of this size; None if it has none.

    Uses the 35 mm equivalent, which does not depend on the resolution.
    """
    try:
        with open_regular(path) as file, open_image(path, file) as image:
            value = read_exif(image).get_ifd(EXIF_DIRECTORY).get(FOCAL_LENGTH_35MM)
        focal_mm = float(value) if value is not None else 0.0
    except Exception:  # Pillow raises many types for damaged metadata, which is not an error here
        return None
    return _in_pixels(focal_mm, width, height) if 0 < focal_mm < np.inf else None


def _in_pixels(focal_mm: float, width: int, height: int) -> float:
    """A 35 mm equivalent focal length in pixels, for an image of this size."""
    return focal_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height))
