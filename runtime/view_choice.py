"""Which of many photographs to use: pairs that share what they see, from places far enough apart to measure depth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .cameras import Camera, invert_rigid
from .errors import InputError

FEWEST_VIEWS = 2

# The parallax of a good pair, seen from what both look at: wide enough to measure depth, narrow enough to match.
GOOD_PARALLAX_DEG = 5.0
# Half the overlap costs as much as a parallax this many times (in powers of two) too large or too small.
OVERLAP_WEIGHT = 2.0
LEAST_OVERLAP = 1e-3
# Points a side, in each picture, that stand for what its camera sees.
GRID = 6
# The share of the cameras' movement that a common point of view must explain to be believed.
FOCUS_EXPLAINS = 0.5
# The scene's distance where the cameras have no common point of view, in longest baselines.
UNKNOWN_DISTANCE = 3.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """What two cameras have in common, for each two, [cameras, cameras].

    overlap: share of what one sees that the other sees too, the smaller of both ways.
    parallax: mean angle in degrees between their sights of what both see; 0 where they share nothing.
    """

    overlap: np.ndarray
    parallax: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """How far each pair is from a good one; infinite without parallax."""
        with np.errstate(divide="ignore"):
            cost = np.abs(np.log2(self.parallax / GOOD_PARALLAX_DEG))
        cost = cost - OVERLAP_WEIGHT * np.log2(np.maximum(self.overlap, LEAST_OVERLAP))
        return np.round(cost, 6)  # equally good pairs are equal whatever the rounding of their poses


def choose_views(cameras: Sequence[Camera], count: int, distances: np.ndarray | None = None) -> list[int]:
    """Choose `count` cameras that see a common region with good baselines; indices in rising order.

    A pair is good when each sees what the other sees, and the parallax, seen from the scene, is near 5 degrees. The
    best pair comes first; then, again and again, the camera that makes the best pair with its nearest chosen one. Ties
    go to the lower index. distances: how far from each camera the scene is, [cameras]; else from `guess_distances`.
    Raises InputError if there are fewer cameras than asked for, or none sees what another sees from another place.
    """
    total = len(cameras)
    if not FEWEST_VIEWS <= count <= total:
        raise InputError(f"{count} views asked for, expected {FEWEST_VIEWS} to {total}, the number of images")
    if count == total:
        return list(range(total))
    cost = compare(cameras, guess_distances(cameras) if distances is None else distances).cost
    if not np.isfinite(cost).any():
        raise InputError(
            "no two cameras see the same from different places; depth needs a baseline. Choose other --frames"
        )
    baselines = _baselines(cameras)
    chosen = [int(index) for index in np.unravel_index(cost.argmin(), cost.shape)]
    while len(chosen) < count:
        rest = np.setdiff1d(np.arange(total), chosen)
        nearest = np.array(chosen)[baselines[rest][:, chosen].argmin(axis=1)]  # [rest]
        chosen.append(int(rest[cost[rest, nearest].argmin()]))
    return sorted(chosen)


def compare(cameras: Sequence[Camera], distances: np.ndarray) -> Pairs:
    """Hold each two cameras against each other, by points at the scene's distance, [cameras], from each."""
    total = len(cameras)
    centres = np.stack([camera.extrinsics[:3, 3] for camera in cameras])  # [cameras, 3]
    points = np.stack([_seen(camera, distance) for camera, distance in zip(cameras, distances, strict=True)])
    sights = _unit(points - centres[:, None])  # [cameras, points, 3]
    overlap, angle = np.zeros((total, total)), np.zeros((total, total))
    for j, camera in enumerate(cameras):
        inside = _sees(camera, points)  # [cameras, points]
        cosine = (sights * _unit(points - centres[j])).sum(axis=-1)
        overlap[:, j] = inside.mean(axis=1)
        angle[:, j] = (inside * np.arccos(np.clip(cosine, -1, 1))).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
    np.fill_diagonal(angle, 0)
    both = (overlap > 0) & (overlap.T > 0)
    return Pairs(np.minimum(overlap, overlap.T), np.degrees((angle + angle.T) / 2) * both)


def guess_distances(cameras: Sequence[Camera]) -> np.ndarray:
    """How far from each camera the scene is, [cameras], without looking at the pictures.

    It is in the middle of the depths a camera is known to see. Where that is not known of a camera, the scene is where
    the optical axes come closest to each other, or, where the cameras do not look at a common place, at three times the
    longest baseline.
    """
    common = _common_distance(cameras)
    known = [camera.depth_range for camera in cameras]
    return np.array([common if depths is None else np.sqrt(depths[0] * depths[1]) for depths in known])


def _common_distance(cameras: Sequence[Camera]) -> float:
    """Distance at which points on the optical axes come closest to each other, by least squares."""
    extrinsics = np.stack([camera.extrinsics for camera in cameras])
    positions = extrinsics[:, :3, 3] - extrinsics[:, :3, 3].mean(axis=0)
    forward = extrinsics[:, :3, 2] - extrinsics[:, :3, 2].mean(axis=0)
    # |positions + distance * forward|^2 is least at distance = -joint / (forward * forward), having lost this share:
    joint, movement, turning = (positions * forward).sum(), (positions**2).sum(), (forward**2).sum()
    if joint < 0 and joint**2 > FOCUS_EXPLAINS * movement * turning:
        return float(-joint / turning)
    return UNKNOWN_DISTANCE * float(_baselines(cameras).max())


def _seen(camera: Camera, distance: float) -> np.ndarray:
    """Points spread over the picture, at this depth, in the world, [GRID * GRID, 3]."""
    steps = (np.arange(GRID) + 0.5) / GRID
    x, y = (side.ravel() for side in np.meshgrid(steps * camera.width, steps * camera.height))
    rays = (np.stack([x, y], axis=-1) - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    points = distance * np.hstack([rays, np.ones((len(rays), 1))])
    return points @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]


def _sees(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Which world points [..., 3] are inside the camera's picture, bool [...]."""
    world_to_camera = invert_rigid(camera.extrinsics)
    x, y, z = np.moveaxis(points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3], -1, 0)
    depth = np.where(z > 0, z, np.inf)
    u, v = camera.K[0, 0] * x / depth + camera.K[0, 2], camera.K[1, 1] * y / depth + camera.K[1, 2]
    return (z > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(float).tiny)


def _baselines(cameras: Sequence[Camera]) -> np.ndarray:
    """Distances between cameras, [cameras, cameras]."""
    positions = np.stack([camera.extrinsics[:3, 3] for camera in cameras])
    return np.linalg.norm(positions[:, None] - positions[None], axis=-1)
