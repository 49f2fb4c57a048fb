"""Morton (Z-curve) order, in which neighbours in space are close to each other in a file."""

import numpy as np

BITS = 21  # of a coordinate: three fill 63 bits
# Shifts and masks that insert two zeros between any two bits of a number.
SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices [points] that sort points [points, 3], finite numbers, by Morton code within their bounding box."""
    points = points.astype(np.float64)
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    cells = (points - low) * ((2**BITS - 1) / np.maximum(high - low, np.finfo(np.float32).tiny))
    code = np.zeros(len(points), np.uint64)
    for axis, values in enumerate(cells.astype(np.uint64).T):
        for shift, mask in SPREAD:
            values = (values | values << np.uint64(shift)) & np.uint64(mask)
        code |= values << np.uint64(axis)
    return np.argsort(code, kind="stable")
