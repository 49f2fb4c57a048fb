"""Image sizes: the option --size, and the sizes that a network accepts."""

from math import ceil, log

from ..errors import InputError
from ..system.limits import SIDE_PIXELS, parse_whole_number

# Factors by which the pixels of a whole frame may exceed those asked for: in general, and rather than be cropped.
MAX_EXTRA_AREA, MAX_AREA_UNCROPPED = 1.3, 1.5
AREA_WEIGHT = 0.5  # of the logarithm of the area against that of the aspect ratio
MAX_STRETCH = 1.15  # of one axis against the other, by which a whole frame may be resized rather than cropped
SEARCHED = 8  # multiples to try for its width, and beyond the exact one for its height
SHOWN = 40  # characters of an option that a message repeats


def parse_size(text: str) -> tuple[int, int]:
    """The option --size, `HEIGHTxWIDTH`, as two numbers; raises InputError."""
    sides = [parse_whole_number(part) for part in text.lower().split("x")]
    if len(sides) != 2 or not all(sides):
        raise InputError(f"--size {text[:SHOWN]}: expected HEIGHTxWIDTH, such as 256x256")
    height, width = (side or 0 for side in sides)
    if max(height, width) > SIDE_PIXELS.value:
        raise InputError(
            f"--size {text}: expected sides of {SIDE_PIXELS.value} pixels at most; choose a smaller one, or "
            f"{SIDE_PIXELS.remedy}"
        )
    return height, width


def is_valid_size(height: int, width: int, multiple: int) -> bool:
    """Whether a network with this size multiple accepts the size."""
    return height % multiple == width % multiple == 0 and min(height, width) >= 2 * multiple


def whole_frame_size(aspect: float, area: int, multiple: int) -> tuple[int, int]:
    """Height and width, multiples of `multiple`, of the aspect ratio (height / width) and of `area` pixels or more.

    Its aspect ratio is near, within MAX_STRETCH if possible, so that nothing is cropped. Its pixels are few more, at
    most MAX_EXTRA_AREA times the area, or MAX_AREA_UNCROPPED where frames of few multiples would else be cropped.
    """
    candidates = []
    for rows in range(2, round((area * aspect) ** 0.5 / multiple) + SEARCHED):
        height = rows * multiple
        least = max(2, ceil(area / height / multiple))
        for width in range(multiple * least, multiple * (least + SEARCHED), multiple):
            stretch = abs(log(height / width / aspect))
            cost = stretch + AREA_WEIGHT * log(height * width / area)
            cropped, large = stretch > log(MAX_STRETCH), height * width > MAX_EXTRA_AREA * area
            candidates.append((cropped, large, cost, height, width))
    fitting = [found for found in candidates if found[3] * found[4] <= MAX_AREA_UNCROPPED * area]
    return min(fitting or candidates)[3:]


def describe_size_rule(multiple: int) -> str:
    """The rule of `is_valid_size`, for messages."""
    return f"height and width must be multiples of {multiple} from {2 * multiple}"
