"""Which of many photographs to use: pairs that share what they see, from places far enough apart to measure depth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.baselines import longest_baseline

MIN_VIEWS = 2

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
# Up to so many cameras every pair is scored; of more, those pairs that promise to be good.
EXHAUSTIVE = 512
PAIRS_AT_ONCE = 1024  # that are scored together, in some 10 MB
# Where a good partner of a camera would stand, in baselines of GOOD_PARALLAX_DEG: to all sides, ahead and behind.
SIDES = 8
AHEAD = (2.0, 6.0)
PARTNERS = 3  # cameras nearest to each such place whose pairs are scored


@dataclass(frozen=True, eq=False)
class PairwiseScores:
    """What two cameras have in common, for each pair; arrays of any one shape.

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


def select_views(cameras: Sequence[Camera], count: int, distances: np.ndarray | None = None) -> list[int]:
    """Choose `count` cameras that see a common region with good baselines; indices in rising order.

    A pair is good when each sees what the other sees, and the parallax, seen from the scene, is near 5 degrees. The
    best pair comes first; then, again and again, the camera that makes the best pair with its nearest chosen one. Ties
    go to the lower index. distances: how far from each camera the scene is, [cameras]; else from `guess_scene_depths`.
    Raises InputError if there are fewer cameras than asked for, or none sees what another sees from another place.
    """
    total = len(cameras)
    if not MIN_VIEWS <= count <= total:
        raise InputError(f"{count} views asked for, expected {MIN_VIEWS} to {total}, the number of images")
    if count == total:
        return list(range(total))
    scorer = PairScorer(cameras, guess_scene_depths(cameras) if distances is None else distances)
    first, second = _pairs_to_score(scorer)
    cost = scorer.score(first, second).cost
    if not np.isfinite(cost).any():
        raise InputError(
            "no two cameras see the same from different places; depth needs a baseline. Choose other --frames"
        )
    best = cost.argmin()
    return sorted(_more_views(scorer, [int(first[best]), int(second[best])], count))


def score_pairs(cameras: Sequence[Camera], distances: np.ndarray) -> PairwiseScores:
    """Score each two cameras, [cameras, cameras], by points at the scene's distance, [cameras], from each."""
    total = len(cameras)
    first, second = np.triu_indices(total, 1)
    pairs = PairScorer(cameras, distances).score(first, second)
    overlap, parallax = np.eye(total), np.zeros((total, total))
    for whole, values in ((overlap, pairs.overlap), (parallax, pairs.parallax)):
        whole[first, second] = whole[second, first] = values
    return PairwiseScores(overlap, parallax)


class PairScorer:
    """Scores pairs of cameras by points at the scene's distance, [cameras], from each."""

    def __init__(self, cameras: Sequence[Camera], distances: np.ndarray) -> None:
        poses = np.stack([camera.extrinsics for camera in cameras])
        self.rotations, self.centres = poses[:, :3, :3], poses[:, :3, 3]
        self.distances = np.asarray(distances, np.float64)
        self.sizes = np.array([(camera.width, camera.height) for camera in cameras], np.float64)  # [cameras, 2]
        Ks = np.stack([camera.K for camera in cameras])
        self.focals, self.principal = Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2]
        self.points = self._seen()

    def score(self, first: np.ndarray, second: np.ndarray) -> PairwiseScores:
        """Score the pairs of cameras with these indices, [pairs] each."""
        overlap, parallax = np.zeros(len(first)), np.zeros(len(first))
        for start in range(0, len(first), PAIRS_AT_ONCE):
            part = slice(start, start + PAIRS_AT_ONCE)
            i, j = first[part], second[part]
            (there, forth), (back, reverse) = self._look(i, j), self._look(j, i)
            both = (there > 0) & (back > 0)
            overlap[part] = np.minimum(there, back)
            parallax[part] = np.degrees((forth + reverse) / 2) * both
        return PairwiseScores(overlap, parallax)

    def _seen(self) -> np.ndarray:
        """Points spread over each image, at the scene's distance, in the world, [3, cameras, GRID * GRID]."""
        steps = (np.arange(GRID) + 0.5) / GRID
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        rays = (grid * self.sizes[:, None] - self.principal[:, None]) / self.focals[:, None]
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
        points = self.distances[:, None, None] * rays
        points = points @ self.rotations.transpose(0, 2, 1) + self.centres[:, None]
        return np.ascontiguousarray(points.transpose(2, 0, 1))  # NumPy is slow where its innermost loop is short

    def _look(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The share of cameras i's points that cameras j see, and the mean angle of both sights of these, [pairs]."""
        points = self.points[:, i]
        from_i, from_j = (points - self.centres[camera].T[..., None] for camera in (i, j))  # [3, pairs, points]
        rotation = self.rotations[j].transpose(1, 2, 0)[..., None]  # [3, 3, pairs, 1]
        x, y, z = ((from_j * rotation[:, column]).sum(axis=0) for column in range(3))
        depth = np.where(z > 0, z, np.inf)
        inside = z > 0
        for axis, side in enumerate((x, y)):
            pixel = self.focals[j, axis, None] * side / depth + self.principal[j, axis, None]
            inside &= (pixel >= 0) & (pixel <= self.sizes[j, axis, None])
        chord = np.sqrt(((_unit(from_i) - _unit(from_j)) ** 2).sum(axis=0))
        angle = 2 * np.arcsin(np.minimum(chord / 2, 1))
        return inside.mean(axis=1), (inside * angle).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)


def _pairs_to_score(scorer: PairScorer) -> tuple[np.ndarray, np.ndarray]:
    """Indices of cameras among whose pairs the best one is looked for, in rising order, [pairs] each."""
    total = len(scorer.centres)
    if total <= EXHAUSTIVE:
        return np.triu_indices(total, 1)
    promising = _promising_pairs(scorer)
    spread = np.linspace(0, total - 1, EXHAUSTIVE // 4).round().astype(int)  # whatever the cameras' arrangement is
    first, second = np.triu_indices(len(spread), 1)
    spread_pairs = np.stack([spread[first], spread[second]], axis=1)
    both = np.unique(np.concatenate([promising, spread_pairs]), axis=0)
    return both[:, 0], both[:, 1]


def _promising_pairs(scorer: PairScorer) -> np.ndarray:
    """Pairs of cameras, [pairs, 2], which look at the same place from places that are a good baseline apart.

    A tree finds those nearest to where a good partner would stand and look.
    """
    from scipy.spatial import cKDTree

    total = len(scorer.centres)
    right, down, forward = np.moveaxis(scorer.rotations, -1, 0)  # [cameras, 3] each
    distances = scorer.distances[:, None]
    baselines = distances * np.tan(np.radians(GOOD_PARALLAX_DEG))
    baseline = np.median(baselines)
    half_view = np.median(distances * scorer.sizes / scorer.focals) / 2
    looked_at = (scorer.centres + distances * forward) / half_view
    tree = cKDTree(np.hstack([scorer.centres / baseline, looked_at]))
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    offsets = [np.cos(angle) * right + np.sin(angle) * down for angle in angles]
    offsets += [sign * step * forward for step in AHEAD for sign in (1, -1)]
    cameras = np.repeat(np.arange(total), PARTNERS)
    pairs = []
    for offset in offsets:
        wanted = np.hstack([(scorer.centres + baselines * offset) / baseline, looked_at])
        partners = tree.query(wanted, PARTNERS)[1].ravel()
        pairs.append(np.stack([np.minimum(cameras, partners), np.maximum(cameras, partners)], axis=1))
    found = np.unique(np.concatenate(pairs), axis=0)
    return found[found[:, 0] < found[:, 1]]


def _more_views(scorer: PairScorer, chosen: list[int], count: int) -> list[int]:
    """To the chosen cameras, again and again, the one that makes the best pair with its nearest chosen one."""
    total = len(scorer.centres)
    nearest, cost = np.full(total, np.inf), np.full(total, np.inf)  # distance from the nearest chosen one, and its cost
    added = list(chosen)
    while len(chosen) < count:
        for camera in added:
            away = np.linalg.norm(scorer.centres - scorer.centres[camera], axis=-1)
            closer = np.flatnonzero(away < nearest)
            nearest[closer] = away[closer]
            cost[closer] = scorer.score(closer, np.full(len(closer), camera)).cost
        rest = np.setdiff1d(np.arange(total), chosen)
        added = [int(rest[cost[rest].argmin()])]
        chosen += added
    return chosen


def guess_scene_depths(cameras: Sequence[Camera]) -> np.ndarray:
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
    return UNKNOWN_DISTANCE * longest_baseline(positions)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [3, ...] scaled to a length of 1."""
    return vectors / np.sqrt(np.maximum((vectors**2).sum(axis=0), np.finfo(float).tiny))
