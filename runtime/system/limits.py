"""Limits against damaged or malicious files that would exhaust memory, each with an environment variable.

A message about a limit ends in `Limit.remedy`.
"""

import os
from dataclasses import dataclass

from ..errors import InputError

LARGEST_LIMIT = 10**12
MOST_DIGITS = 18


@dataclass(frozen=True)
class Limit:
    """A limit with an environment variable that overrides it.

    variable: its name. default: the value without it. unit: for messages.
    """

    variable: str
    default: int
    unit: str

    @property
    def value(self) -> int:
        """The current limit. Raises InputError if the variable is not a positive whole number."""
        text = os.environ.get(self.variable, "")
        if not text:
            return self.default
        number = parse_whole_number(text)
        if not number or number > LARGEST_LIMIT:
            raise InputError(f"{self.variable}={text}: expected a whole number of {self.unit}, 1 to {LARGEST_LIMIT}")
        return number

    @property
    def remedy(self) -> str:
        """How to raise the limit, for messages."""
        return f"set the environment variable {self.variable} to more than {self.value}"


# Of an image or video frame. Phones take images of up to 200 megapixels; decoded, a pixel takes 3 bytes.
IMAGE_MEGAPIXELS = Limit("IDESPLAT_MAX_MEGAPIXELS", 256, "megapixels")
# A Gaussian takes 44 to 236 bytes in memory and at least 8 in a file, so scenes expand by at most a factor of 30.
EXPANSION = Limit("IDESPLAT_MAX_EXPANSION", 64, "bytes in memory for one in the file")
# Of a side in --size.
SIDE_PIXELS = Limit("IDESPLAT_MAX_SIDE", 8192, "pixels")


def parse_whole_number(text: str) -> int | None:
    """A number of at most MOST_DIGITS ASCII digits; None for anything else, such as `²`, a digit to `str.isdigit`."""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS else None
