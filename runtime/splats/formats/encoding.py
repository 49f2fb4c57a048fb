"""Rounding to 8 bits, and notes about what a format cannot hold: shared by the splat formats."""

import numpy as np

# Of a limit: values that were read from a file lie up to float32's rounding beyond it.
LEAST_CHANGE = 1e-6


def round_to_uint8(values: np.ndarray) -> np.ndarray:
    """The nearest integers from 0 to 255, uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def clipped_note(name: str, values: np.ndarray, low: float, high: float) -> list[str]:
    """A line about the values outside a format's range, which are clipped; no line if there are none."""
    least, most = low - LEAST_CHANGE * abs(low), high + LEAST_CHANGE * abs(high)
    count = int(np.count_nonzero((values < least) | (values > most)))
    return [f"{count:,} of {values.size:,} {name} outside {low:.3g} to {high:.3g} were clipped"] if count else []


def lost_offset(offset: np.ndarray | None) -> list[str]:
    """A line about an offset [3] that a format cannot record; no line for None or zero."""
    if offset is None or not offset.any():
        return []
    return [f"the file does not record that its coordinates are relative to {', '.join(map(repr, offset.tolist()))}"]
