"""Checked reading of camera files: numbers, names and poses in JSON objects and in lines of text.

All functions raise InputError.
"""

import json
import math
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..errors import InputError, error_context
from ..geometry.rigid import check_rigid
from ..system.files import read_bytes

EXPECTED = "a file of cameras"
MAX_FILE_SIZE = 512 * 2**20  # bytes


def read_text(path: Path) -> str:
    """A UTF-8 text file, without a byte order mark."""
    try:
        return read_bytes(path, EXPECTED, MAX_FILE_SIZE).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"is not text, expected {EXPECTED}") from None


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file."""
    content = read_bytes(path, EXPECTED, MAX_FILE_SIZE)
    try:
        document = json.loads(content)
    except RecursionError:
        raise InputError("is not a file of cameras: JSON nested too deeply") from None
    except ValueError as error:  # invalid JSON or UTF-8, or an integer with thousands of digits
        raise InputError(f"is not valid JSON ({error}); expected {EXPECTED}") from None
    if not isinstance(document, dict):
        raise InputError(f"holds {short_repr(document)}, expected a JSON object with cameras")
    return document


def entries(document: Mapping[str, Any], field: str) -> list[dict[str, Any]]:
    """The objects in the list `field`, at least one."""
    found = document.get(field)
    if not isinstance(found, list) or not found or not all(isinstance(entry, dict) for entry in found):
        raise InputError(f"{field} is {short_repr(found)}, expected a list of at least one object")
    return found


def image_name(entry: Mapping[str, Any], field: str) -> str:
    """An image path."""
    value = entry.get(field)
    if not isinstance(value, str) or not PurePosixPath(value).name:
        raise InputError(f"{field} is {short_repr(value)}, expected the path of an image")
    return value


def number(entry: Mapping[str, Any], field: str) -> float:
    """A finite number."""
    if field not in entry:
        raise InputError(f"{field} is missing, expected a number")
    return finite(entry[field], field)


def finite(value: object, field: str) -> float:
    """The value as a float. field: its name, for the message."""
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise InputError(f"{field} is {short_repr(value)}, expected a finite number")


def pixels(entry: Mapping[str, Any], field: str) -> int:
    """A positive whole number of pixels."""
    value = number(entry, field)
    if value <= 0 or value != int(value):
        raise InputError(f"{field} is {value:g}, expected a positive whole number of pixels")
    return int(value)


def pose(entry: Mapping[str, Any], field: str) -> np.ndarray:
    """A rigid transform, [4, 4]."""
    rows = entry.get(field)
    if not (isinstance(rows, list) and len(rows) == 4 and all(isinstance(row, list) and len(row) == 4 for row in rows)):
        raise InputError(f"{field} is {short_repr(rows)}, expected the camera's pose as 4 rows of 4 numbers")
    with error_context(field):
        return check_rigid(np.array([[finite(value, f"row {i}") for value in row] for i, row in enumerate(rows)]))


def numbers(words: Sequence[str]) -> list[float]:
    """Words of a text file as finite numbers."""
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"holds {short_repr(word)}, expected a finite number")
        values.append(value)
    return values


def short_repr(value: object) -> str:
    """A value as text for a message, shortened."""
    return "missing" if value is None else reprlib.repr(value)
