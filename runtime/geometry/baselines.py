"""Baselines: distances between camera positions."""

import numpy as np

ROWS_AT_ONCE = 64  # positions whose distances to all others are computed together, to bound the memory


def pairwise_baselines(extrinsics: np.ndarray) -> np.ndarray:
    """Distances between all cameras, [cameras, cameras], from camera-to-world poses [cameras, 4, 4]."""
    positions = extrinsics[:, :3, 3]
    return np.linalg.norm(positions[:, None] - positions[None], axis=-1)


def nearest_neighbor_pairs(extrinsics: np.ndarray) -> list[tuple[int, int]]:
    """Each camera paired with its nearest one: sorted pairs (i, j), i < j, without duplicates."""
    distances = pairwise_baselines(extrinsics)
    np.fill_diagonal(distances, np.inf)
    return sorted({(min(i, j), max(i, j)) for i, j in enumerate(distances.argmin(axis=1).tolist())})


def longest_baseline(positions: np.ndarray) -> float:
    """The largest distance between two of the positions [cameras, 3], in O(cameras) memory."""
    longest = 0.0
    for start in range(0, len(positions), ROWS_AT_ONCE):
        apart = positions[start : start + ROWS_AT_ONCE, None] - positions[None]
        longest = max(longest, float(np.einsum("ijk,ijk->ij", apart, apart).max()))
    return float(np.sqrt(longest))
