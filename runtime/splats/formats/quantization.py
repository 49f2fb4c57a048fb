"""Numbers in few bits, as compact formats hold them."""

import numpy as np


def round_to_uint8(values: np.ndarray) -> np.ndarray:
    """The nearest whole number from 0 to 255, uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def clipped_note(name: str, values: np.ndarray, low: float, high: float) -> list[str]:
    """A line about the values that a format's range does not reach, if there are any."""
    count = int(np.count_nonzero((values < low) | (values > high)))
    return [f"{count:,} of {values.size:,} {name} outside {low:.3g} to {high:.3g} moved to its ends"] if count else []
