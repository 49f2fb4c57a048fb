"""Near and far bounds of an image from a sparse set of its depths."""

import numpy as np

MIN_POINTS = 20
NEAR_PERCENTILE, FAR_PERCENTILE = 2, 98  # against outliers
# Surfaces without points may lie outside the range of the points. A wider range leaves fewer of them out, and has fewer
# depth candidates where the surfaces are: with 2 instead of 1.5, two views of the validation captures lose 0.25 dB.
NEAR_FACTOR, FAR_FACTOR = 0.5, 1.5


def depth_bounds(depths: np.ndarray) -> tuple[float, float] | None:
    """Near and far, from depths [points], in their unit; None for fewer than MIN_POINTS valid depths."""
    depths = depths[np.isfinite(depths) & (depths > 0)]
    if len(depths) < MIN_POINTS:
        return None
    nearest, farthest = np.percentile(depths, (NEAR_PERCENTILE, FAR_PERCENTILE)).tolist()
    return NEAR_FACTOR * nearest, FAR_FACTOR * farthest
