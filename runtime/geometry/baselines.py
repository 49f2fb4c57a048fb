"""Baselines: distances between camera positions, and cameras that coincide."""

import numpy as np

ROWS_AT_ONCE = 64  # positions whose distances to all others are computed together, to bound the memory
SAME_POSITION = 1e-4  # relative to the longest baseline
SAME_ROTATION = 1e-4  # largest difference between the elements of two rotation matrices
ROUNDING_STEPS = 4  # of the poses' floating-point type, at the largest coordinate


def pairwise_baselines(extrinsics: np.ndarray) -> np.ndarray:
    """Distances between all cameras, [cameras, cameras], from camera-to-world poses [cameras, 4, 4]."""
    positions = extrinsics[:, :3, 3]
    return np.linalg.norm(positions[:, None] - positions[None], axis=-1)


def nearest_neighbor_pairs(extrinsics: np.ndarray) -> list[tuple[int, int]]:
    """Each camera paired with its nearest one: sorted pairs (i, j), i < j, without duplicates."""
    distances = pairwise_baselines(extrinsics)
    np.fill_diagonal(distances, np.inf)
    return sorted({(min(i, j), max(i, j)) for i, j in enumerate(distances.argmin(axis=1).tolist())})


def connected_neighbor_pairs(extrinsics: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Each camera paired with its `count` nearest ones, and the pairs that connect all cameras over least distances.

    Sorted pairs (i, j), i < j, without duplicates. The connecting pairs are those of a minimum spanning tree.
    """
    distances = pairwise_baselines(extrinsics)
    np.fill_diagonal(distances, np.inf)
    nearest = np.argsort(distances, axis=1, kind="stable")[:, : min(count, len(distances) - 1)]
    pairs = {(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row}
    reached = np.arange(len(distances)) == 0
    while not reached.all():  # Prim's algorithm
        outward = np.where(reached[:, None] & ~reached, distances, np.inf)
        i, j = divmod(int(outward.argmin()), len(distances))
        reached[j] = True
        pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def longest_baseline(positions: np.ndarray) -> float:
    """The largest distance between two of the positions [cameras, 3], in O(cameras) memory."""
    longest = 0.0
    for start in range(0, len(positions), ROWS_AT_ONCE):
        apart = positions[start : start + ROWS_AT_ONCE, None] - positions[None]
        longest = max(longest, float(np.einsum("ijk,ijk->ij", apart, apart).max()))
    return float(np.sqrt(longest))


def position_rounding(extrinsics: np.ndarray) -> float:
    """The distance within which positions are equal but for rounding; for poses [cameras, 4, 4], in their unit."""
    return ROUNDING_STEPS * float(np.finfo(extrinsics.dtype).eps * np.abs(extrinsics[:, :3, 3]).max())


def have_baseline(extrinsics: np.ndarray) -> bool:
    """Whether two of the cameras are at different positions, beyond rounding; for poses [cameras, 4, 4]."""
    return bool(pairwise_baselines(extrinsics).max() > position_rounding(extrinsics))


def coinciding_poses(extrinsics: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of poses [cameras, 4, 4] with the same position and rotation, up to rounding."""
    baselines, rotations = pairwise_baselines(extrinsics), extrinsics[:, :3, :3]
    apart = max(SAME_POSITION * baselines.max(), position_rounding(extrinsics))
    found = []
    for i in range(len(extrinsics)):
        same = (np.abs(rotations - rotations[i]).max(axis=(1, 2)) <= SAME_ROTATION) & (baselines[i] <= apart)
        found += [(i, j) for j in np.flatnonzero(same).tolist() if i < j]
    return found
