"""Few values that stand for many: codebooks of numbers, palettes of vectors."""

import numpy as np

from ...system.progress import progress

ENTRIES = 256  # of a codebook: an index is a byte
QUANTILES = 1 << 16  # which are enough to know how values lie
PALETTE = 4096  # vectors, where more than that are to be replaced
SAMPLE = 1 << 16  # vectors that a palette is learned from
ROUNDS = 8  # of k-means
PIECES = 32  # in which many vectors find their place, so that a progress bar moves
ROWS_AT_ONCE = 1 << 12  # their distances to a palette fit into the cache


def build_codebook(values: np.ndarray) -> np.ndarray:
    """256 rising numbers, float32, that stand for values of any shape.

    Half of them are spread evenly over the range, so that no value is farther from one than 1/256 of it, and half as
    densely as the values lie.
    """
    places = (np.arange(ENTRIES) + 0.5) / ENTRIES
    ordered = np.sort(values, axis=None).astype(np.float64)
    ordered = ordered[np.linspace(0, len(ordered) - 1, min(len(ordered), QUANTILES)).astype(np.int64)]
    even = np.linspace(ordered[0], ordered[-1], len(ordered))
    # The inverse of the mean of two distribution functions, the even one and that of the values.
    grid = np.concatenate([ordered, even])
    share = 0.5 * np.searchsorted(ordered, grid, side="right") / len(ordered)
    width = max(ordered[-1] - ordered[0], np.finfo(np.float32).tiny)
    share += 0.5 * (grid - ordered[0]) / width
    order = np.argsort(grid, kind="stable")
    return np.interp(places, share[order], grid[order]).astype(np.float32)


def quantize(values: np.ndarray, book: np.ndarray) -> np.ndarray:
    """The index of the nearest entry of a codebook, uint8, for values of any shape."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def cluster_vectors(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors [colours, parts] and, for each of vectors [n, parts], the index [n] of the one that stands for it.

    Few vectors stand for themselves. Of many, the palette is learned by k-means, always the same for the same vectors.
    """
    if len(vectors) <= PALETTE:
        return vectors, np.arange(len(vectors))
    rng = np.random.default_rng(0)
    sample = vectors[rng.choice(len(vectors), min(SAMPLE, len(vectors)), replace=False)]
    centres = sample[:PALETTE].copy()
    for _ in progress(range(ROUNDS), "learning a palette"):
        labels = _nearest_vectors(sample, centres)
        counts = np.bincount(labels, minlength=PALETTE)
        sums = np.stack([np.bincount(labels, part, PALETTE) for part in sample.T], axis=1)
        used = counts > 0
        centres[used] = sums[used] / counts[used, None]
    pieces = np.array_split(vectors, PIECES)
    return centres, np.concatenate(
        [_nearest_vectors(piece, centres) for piece in progress(pieces, "using the palette")]
    )


def _nearest_vectors(vectors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The index of the nearest centre for each vector."""
    half_norms = 0.5 * np.square(centres).sum(axis=1)
    labels = np.empty(len(vectors), np.int64)
    for start in range(0, len(vectors), ROWS_AT_ONCE):
        block = vectors[start : start + ROWS_AT_ONCE]
        labels[start : start + ROWS_AT_ONCE] = (block @ centres.T - half_norms).argmax(axis=1)
    return labels
