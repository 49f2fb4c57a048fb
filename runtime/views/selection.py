"""Selection of views: pairs of cameras with large overlap and a parallax that suits depth estimation.

`select_views` is greedy, and `PairScorer` scores the pairs. To change how views are selected, change this module.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.baselines import longest_baseline

MIN_VIEWS = 2

# The ideal parallax of a pair: large enough for accurate depth, small enough for matching.
IDEAL_PARALLAX_DEG = 5.0
# Halving the overlap costs as much as a parallax that is off by this power of two.
OVERLAP_WEIGHT = 2.0
MIN_OVERLAP = 1e-3
# Points per side of the grid in each image at which overlap and parallax are evaluated.
GRID = 6
# Fraction of the variance of the camera positions that a common fixation point must explain to be used.
MIN_EXPLAINED_VARIANCE = 0.5
# Scene depth without a common fixation point, in longest baselines.
DEFAULT_DEPTH = 3.0
MAX_EXHAUSTIVE = 512  # cameras; of more, only candidate pairs are scored
PAIRS_AT_ONCE = 1024  # pairs scored together, in about 10 MB
# Candidate pairs: the cameras nearest to ideal positions around each camera, at baselines of IDEAL_PARALLAX_DEG.
SIDES = 8  # directions in the image plane
AHEAD = (2.0, 6.0)  # baselines along the optical axis, in both directions
PARTNERS = 3  # nearest cameras to each ideal position


@dataclass(frozen=True, eq=False)
class PairwiseScores:
    """Overlap and parallax of pairs of cameras; arrays of one shape.

    overlap: fraction of the points of one camera that the other sees, the smaller of both directions.
    parallax: mean angle in degrees between the viewing rays to common points; 0 without overlap.
    """

    overlap: np.ndarray
    parallax: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """|log2(parallax / ideal)| - OVERLAP_WEIGHT log2(overlap): 0 for an ideal pair, infinite without parallax."""
        with np.errstate(divide="ignore"):
            cost = np.abs(np.log2(self.parallax / IDEAL_PARALLAX_DEG))
        cost = cost - OVERLAP_WEIGHT * np.log2(np.maximum(self.overlap, MIN_OVERLAP))
        return np.round(cost, 6)  # so that rounding errors of the poses do not break ties


def select_views(cameras: Sequence[Camera], count: int, depths: np.ndarray | None = None) -> list[int]:
    """Select `count` cameras that see a common region with suitable baselines; returns sorted indices.

    Greedy: the pair of lowest cost first, then repeatedly the camera with the lowest cost in a pair with its nearest
    selected camera. Ties go to the lower index.
    depths: depth of the scene in each camera, [cameras]; by default from `guess_scene_depths`.
    Raises InputError for fewer cameras than `count`, or if no two cameras overlap with a baseline.
    """
    total = len(cameras)
    if not MIN_VIEWS <= count <= total:
        raise InputError(f"{count} views asked for, expected {MIN_VIEWS} to {total}, the number of images")
    if count == total:
        return list(range(total))
    scorer = PairScorer(cameras, guess_scene_depths(cameras) if depths is None else depths)
    first, second = _candidate_pairs(scorer)
    cost = scorer.score(first, second).cost
    if not np.isfinite(cost).any():
        raise InputError(
            "no two cameras see the same from different places; depth needs a baseline; choose others with --select"
        )
    best = cost.argmin()
    return sorted(_extend(scorer, [int(first[best]), int(second[best])], count))


def score_pairs(cameras: Sequence[Camera], depths: np.ndarray) -> PairwiseScores:
    """Scores of all pairs of cameras, [cameras, cameras]. depths: depth of the scene in each camera, [cameras]."""
    total = len(cameras)
    first, second = np.triu_indices(total, 1)
    pairs = PairScorer(cameras, depths).score(first, second)
    overlap, parallax = np.eye(total), np.zeros((total, total))
    for whole, values in ((overlap, pairs.overlap), (parallax, pairs.parallax)):
        whole[first, second] = whole[second, first] = values
    return PairwiseScores(overlap, parallax)


class PairScorer:
    """Scores pairs of cameras on a grid of points in each image, at the scene's depth in that camera, [cameras]."""

    def __init__(self, cameras: Sequence[Camera], depths: np.ndarray) -> None:
        poses = np.stack([camera.extrinsics for camera in cameras])
        self.rotations, self.centres = poses[:, :3, :3], poses[:, :3, 3]
        self.depths = np.asarray(depths, np.float64)
        self.sizes = np.array([(camera.width, camera.height) for camera in cameras], np.float64)  # [cameras, 2]
        Ks = np.stack([camera.K for camera in cameras])
        self.focals, self.principal = Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2]
        self.points = self._grid_points()

    def score(self, first: np.ndarray, second: np.ndarray) -> PairwiseScores:
        """Scores of the pairs (first, second) of camera indices, [pairs] each."""
        overlap, parallax = np.zeros(len(first)), np.zeros(len(first))
        for start in range(0, len(first), PAIRS_AT_ONCE):
            part = slice(start, start + PAIRS_AT_ONCE)
            i, j = first[part], second[part]
            (overlap_ij, angle_ij), (overlap_ji, angle_ji) = self._score_one_way(i, j), self._score_one_way(j, i)
            both = (overlap_ij > 0) & (overlap_ji > 0)
            overlap[part] = np.minimum(overlap_ij, overlap_ji)
            parallax[part] = np.degrees((angle_ij + angle_ji) / 2) * both
        return PairwiseScores(overlap, parallax)

    def _grid_points(self) -> np.ndarray:
        """World positions of the grid points of each camera, [3, cameras, GRID * GRID]."""
        steps = (np.arange(GRID) + 0.5) / GRID
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        rays = (grid * self.sizes[:, None] - self.principal[:, None]) / self.focals[:, None]
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
        points = self.depths[:, None, None] * rays
        points = points @ self.rotations.transpose(0, 2, 1) + self.centres[:, None]
        return np.ascontiguousarray(points.transpose(2, 0, 1))  # NumPy is slow if its innermost loop is short

    def _score_one_way(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fraction of the points of cameras i that cameras j see, and the mean angle of viewing rays, [pairs]."""
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


def _candidate_pairs(scorer: PairScorer) -> tuple[np.ndarray, np.ndarray]:
    """The pairs to score for the best one, as two sorted arrays of camera indices, [pairs] each."""
    total = len(scorer.centres)
    if total <= MAX_EXHAUSTIVE:
        return np.triu_indices(total, 1)
    subset = np.linspace(0, total - 1, MAX_EXHAUSTIVE // 4).round().astype(int)  # a fallback for any arrangement
    first, second = np.triu_indices(len(subset), 1)
    subset_pairs = np.stack([subset[first], subset[second]], axis=1)
    pairs = np.unique(np.concatenate([_neighbor_pairs(scorer), subset_pairs]), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _neighbor_pairs(scorer: PairScorer) -> np.ndarray:
    """Pairs of cameras, [pairs, 2], that look at about the same point from about an ideal baseline.

    A k-d tree over positions and fixation points finds the cameras nearest to each ideal partner.
    """
    from scipy.spatial import cKDTree

    total = len(scorer.centres)
    right, down, forward = np.moveaxis(scorer.rotations, -1, 0)  # [cameras, 3] each
    depths = scorer.depths[:, None]
    baselines = depths * np.tan(np.radians(IDEAL_PARALLAX_DEG))
    baseline = np.median(baselines)
    half_view = np.median(depths * scorer.sizes / scorer.focals) / 2
    fixation = (scorer.centres + depths * forward) / half_view
    tree = cKDTree(np.hstack([scorer.centres / baseline, fixation]))
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    offsets = [np.cos(angle) * right + np.sin(angle) * down for angle in angles]
    offsets += [sign * step * forward for step in AHEAD for sign in (1, -1)]
    cameras = np.repeat(np.arange(total), PARTNERS)
    pairs = []
    for offset in offsets:
        ideal = np.hstack([(scorer.centres + baselines * offset) / baseline, fixation])
        partners = tree.query(ideal, PARTNERS)[1].ravel()
        pairs.append(np.stack([np.minimum(cameras, partners), np.maximum(cameras, partners)], axis=1))
    found = np.unique(np.concatenate(pairs), axis=0)
    return found[found[:, 0] < found[:, 1]]


def _extend(scorer: PairScorer, chosen: list[int], count: int) -> list[int]:
    """Add the camera with the lowest cost in a pair with its nearest selected camera, until there are `count`."""
    total = len(scorer.centres)
    distance, cost = np.full(total, np.inf), np.full(total, np.inf)  # of each camera and its nearest selected one
    added = list(chosen)
    while len(chosen) < count:
        for camera in added:
            to_added = np.linalg.norm(scorer.centres - scorer.centres[camera], axis=-1)
            closer = np.flatnonzero(to_added < distance)
            distance[closer] = to_added[closer]
            cost[closer] = scorer.score(closer, np.full(len(closer), camera)).cost
        rest = np.setdiff1d(np.arange(total), chosen)
        added = [int(rest[cost[rest].argmin()])]
        chosen += added
    return chosen


def guess_scene_depths(cameras: Sequence[Camera]) -> np.ndarray:
    """The depth of the scene in each camera, [cameras], from the cameras alone.

    The geometric mean of a camera's depth range, or without one, the depth at which the optical axes come closest to
    each other; if the cameras have no common fixation point, three times the longest baseline.
    """
    common = _fixation_depth(cameras)
    ranges = [camera.depth_range for camera in cameras]
    return np.array([common if bounds is None else np.sqrt(bounds[0] * bounds[1]) for bounds in ranges])


def _fixation_depth(cameras: Sequence[Camera]) -> float:
    """The depth at which points on the optical axes are closest to each other, by least squares."""
    extrinsics = np.stack([camera.extrinsics for camera in cameras])
    positions = extrinsics[:, :3, 3] - extrinsics[:, :3, 3].mean(axis=0)
    forward = extrinsics[:, :3, 2] - extrinsics[:, :3, 2].mean(axis=0)
    # The sum of |p + d f|^2 is minimal at d = -p.f / f.f, which explains (p.f)^2 / (p.p f.f) of the variance of p.
    pf, pp, ff = (positions * forward).sum(), (positions**2).sum(), (forward**2).sum()
    if pf < 0 and pf**2 > MIN_EXPLAINED_VARIANCE * pp * ff:
        return float(-pf / ff)
    return DEFAULT_DEPTH * longest_baseline(positions)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors [3, ...] in the directions of vectors [3, ...]."""
    return vectors / np.sqrt(np.maximum((vectors**2).sum(axis=0), np.finfo(float).tiny))
