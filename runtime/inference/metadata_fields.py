"""Checks of type and range for the values in the JSON of metadata and manifests, which is not trusted."""

import json
import math
import reprlib
from collections.abc import Callable
from typing import Any, NoReturn

from ..errors import InputError

MAX_STRING = 4096  # characters
MAX_LIST = 256  # entries

Check = Callable[[object], Any]  # returns the value to use; raises InputError with what was expected


def parse_object(text: str | bytes) -> dict[str, Any]:
    """The JSON object in a text; raises InputError where it is none, holds NaN or infinity, or is nested too deeply."""
    try:
        content = json.loads(text, parse_constant=_no_number)
    except RecursionError:
        raise InputError("JSON nested too deeply") from None
    except ValueError as error:  # also text that is not UTF-8, and integers of thousands of digits
        if isinstance(error, InputError):
            raise
        raise InputError(f"not valid JSON ({error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{shown(content)}, expected a JSON object")
    return content


def checked_fields(content: object, checks: dict[str, Check], optional: frozenset[str] = frozenset()) -> dict[str, Any]:
    """The fields of a JSON object that `checks` names, each as its check returns it; others are ignored.

    Raises InputError naming the field that is missing or invalid.
    """
    if not isinstance(content, dict):
        raise InputError(f"{shown(content)}, expected a JSON object")
    found = {}
    for name, check in checks.items():
        if name in content:
            try:
                found[name] = check(content[name])
            except InputError as error:
                raise InputError(f"{name} is {shown(content[name])}, expected {error}") from None
        elif name not in optional:
            raise InputError(f"{name} is missing")
    return found


def string(value: object) -> str:
    """A string of text."""
    if not isinstance(value, str) or len(value) > MAX_STRING:
        raise InputError("a string")
    return value


def flag(value: object) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise InputError("true or false")
    return value


def whole(least: int, most: int) -> Check:
    """A check for whole numbers in a range, both ends included."""

    def check(value: object) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise InputError(f"a whole number from {least} to {most}")
        return value

    return check


def distance(value: object) -> float:
    """A positive, finite number."""
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0 and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise InputError("a positive, finite number")


def pair(check: Check) -> Check:
    """A check for two values in ascending order, such as a minimum and a maximum."""

    def check_pair(value: object) -> list[Any]:
        if not isinstance(value, list) or len(value) != 2:
            raise InputError("a list of two numbers")
        first, second = (check(part) for part in value)
        if first > second:
            raise InputError("a list of two numbers in ascending order")
        return [first, second]

    return check_pair


def names(value: object) -> list[str]:
    """A list of different strings."""
    fits = isinstance(value, list) and len(value) <= MAX_LIST and all(isinstance(name, str) for name in value)
    if not isinstance(value, list) or not fits or len(set(value)) < len(value):
        raise InputError("a list of different names")
    return [string(name) for name in value]


def shown(value: object) -> str:
    """A value for a message, shortened."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 1e18:
        return "a number beyond 1e18"  # Python refuses to print one of thousands of digits
    return reprlib.repr(value)


def _no_number(constant: str) -> NoReturn:
    raise InputError(f"holds {constant}, expected finite numbers")
