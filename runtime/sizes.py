"""Image sizes as commands are given them and as networks take them."""

from .errors import InputError


def parse_size(text: str) -> tuple[int, int]:
    """The option --size, `HEIGHTxWIDTH`, as two numbers; raises InputError."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise InputError(f"--size {text}: expected HEIGHTxWIDTH, such as 256x256")
    return int(parts[0]), int(parts[1])


def size_fits(height: int, width: int, multiple: int) -> bool:
    """Whether a network whose sizes go in steps of `multiple` takes this one."""
    return height % multiple == width % multiple == 0 and min(height, width) >= 2 * multiple


def nearest_size(aspect: float, area: float, multiple: int) -> tuple[int, int]:
    """Height and width in steps of `multiple`, with a quotient near `aspect` and a product near `area` in pixels."""
    height, width = (multiple * max(2, round((area * side) ** 0.5 / multiple)) for side in (aspect, 1 / aspect))
    return height, width


def size_rule(multiple: int) -> str:
    """What `size_fits` asks, in words."""
    return f"height and width must be multiples of {multiple} from {2 * multiple}"
