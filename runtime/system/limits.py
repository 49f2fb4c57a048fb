"""Limits that keep one damaged or hostile file from filling the memory, each with the variable that raises it.

All limits of this kind stand here. A message that names a limit ends in `Limit.remedy`.
"""

import os
from dataclasses import dataclass

from ..errors import InputError

LARGEST_LIMIT = 10**12
MOST_DIGITS = 18


@dataclass(frozen=True)
class Limit:
    """A number that an environment variable replaces.

    variable: its name. default: the number without it. unit: what it counts, for messages.
    """

    variable: str
    default: int
    unit: str

    @property
    def value(self) -> int:
        """The number in force; raises InputError where the variable holds no positive whole number."""
        text = os.environ.get(self.variable, "")
        if not text:
            return self.default
        number = parse_whole_number(text)
        if not number or number > LARGEST_LIMIT:
            raise InputError(f"{self.variable}={text}: expected a whole number of {self.unit}, 1 to {LARGEST_LIMIT}")
        return number

    @property
    def remedy(self) -> str:
        """How to raise it, for the end of a message."""
        return f"set the environment variable {self.variable} to more than {self.value}"


# Of one image or video frame. The largest photographs of telephones have 200; a decoded one takes 3 bytes a pixel.
IMAGE_MEGAPIXELS = Limit("IDESPLAT_MAX_MEGAPIXELS", 256, "megapixels")
# Gaussians take 44 to 236 bytes in memory and formats store 8 of them or more, so scenes expand by 30 at most.
EXPANSION = Limit("IDESPLAT_MAX_EXPANSION", 64, "bytes in memory for one in the file")
# A side of what is computed or rendered, for --size.
SIDE_PIXELS = Limit("IDESPLAT_MAX_SIDE", 8192, "pixels")


def parse_whole_number(text: str) -> int | None:
    """A number of at most MOST_DIGITS ASCII digits; None for anything else, such as `²`, a digit to `str.isdigit`."""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS else None
