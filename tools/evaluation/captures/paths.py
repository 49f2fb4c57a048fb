"""Selection of triples and of a path of views from a survey."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .capture import MAX_VIEWS, window_start
from .survey import Survey

TRIPLES = 3
BASELINE = 0.25  # of a triple, over the depth of what it sees
MIN_BASELINE = 0.08
MAX_ASIDE = 0.7  # how far a held-out frame stands from the line between its neighbours, in baselines
MIN_ALONG, MAX_ALONG = 0.2, 0.8  # where it stands along that line
MAX_ROTATION_DEG = 65  # between any two frames of a triple, roll included
PATH_LENGTHS = (2, 3, 4, 6, 8, 12, MAX_VIEWS)  # views
MIN_SPACING = 0.4  # of the previous step: a view of a path stands farther from all earlier ones
TARGETS = 3  # held-out frames that are tried between each two views
BEAM = 3  # paths that are kept for each last step
TINY = 1e-3


def triple_costs(
    extrinsics: np.ndarray, survey: Survey, good: np.ndarray, least_overlap: float, largest_baseline: float
) -> np.ndarray:
    """The cost of each triple (first, second, target), infinite where not allowed, [frames, frames, frames].

    It adds |log2| of the baseline over `BASELINE`, the target's distance from the middle, and -log2 of the overlap.
    extrinsics: [frames, 4, 4]. good: indices of the frames that may be used.
    """
    positions, rotations = extrinsics[:, :3, 3], extrinsics[:, :3, :3]
    cosines = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    similar = cosines >= np.cos(np.radians(MAX_ROTATION_DEG))
    count = len(positions)
    cost = np.full((count, count, count), np.inf)
    for a in good:
        for b in good[good > a]:
            ratio, seen = survey.baseline[a, b], survey.overlap[a, b]
            if not MIN_BASELINE <= ratio <= largest_baseline or seen < least_overlap or not similar[a, b]:
                continue
            way = positions[b] - positions[a]
            along = (positions[good] - positions[a]) @ way / (way @ way)
            aside = np.linalg.norm(positions[good] - positions[a] - along[:, None] * way, axis=1) / np.linalg.norm(way)
            overlap = np.minimum(seen, np.minimum(survey.overlap[a, good], survey.overlap[b, good]))
            off_middle = 2 * np.abs(along - 0.5) + aside
            found = np.abs(np.log2(ratio / BASELINE)) + off_middle - np.log2(np.maximum(overlap, TINY))
            allowed = (along > MIN_ALONG) & (along < MAX_ALONG) & (aside < MAX_ASIDE) & (overlap >= least_overlap)
            allowed &= similar[a, good] & similar[b, good]
            cost[a, b, good] = cost[b, a, good] = np.where(allowed & (good != a) & (good != b), found, np.inf)
    return cost


def spread_triples(cost: np.ndarray, positions: np.ndarray, survey: Survey) -> list[tuple[int, int, int]]:
    """The best triple, then others of low cost that are far from those already chosen."""
    chosen: list[tuple[int, int, int]] = []
    penalty = np.zeros(len(positions))
    for _ in range(TRIPLES):
        total = cost + penalty
        index = np.unravel_index(np.argmin(total), cost.shape)
        if not np.isfinite(total[index]):
            return chosen
        a, b, target = (int(i) for i in index)
        chosen.append((min(a, b), max(a, b), target))
        near = np.linalg.norm(positions - positions[target], axis=1) / survey.depth[target]
        penalty += 2 * np.exp(-np.square(near / BASELINE))
        penalty[target] = np.inf
    return chosen


@dataclass(frozen=True, order=True)
class ViewPath:
    """Views, with a held-out frame between each two, and the sum of the costs of these triples."""

    cost: float
    views: tuple[int, ...]
    between: tuple[int, ...]


def best_path(cost: np.ndarray, positions: np.ndarray) -> tuple[list[int], list[int]]:
    """The path with the largest of PATH_LENGTHS views that is found, and of these the one with the cheapest windows.

    A beam search over steps of two views and the frame between; no views where there is no triple.
    cost: of triples (`triple_costs`). positions: of the cameras, [frames, 3]. Returns the views and the frames between.
    """
    steps = [_steps(options) for options in cost]
    paths = [ViewPath(value, (a, b), (target,)) for a, options in enumerate(steps) for value, b, target in options]
    best: tuple[list[int], list[int]] = [], []
    while paths:
        length = len(paths[0].views)
        if length in PATH_LENGTHS:
            found = min(paths, key=lambda path: (_window_cost(path, cost), path))
            best = list(found.views), list(found.between)
        if length == PATH_LENGTHS[-1]:
            break
        by_step: dict[tuple[int, int], list[ViewPath]] = {}
        for path in paths:
            for longer in _extended(path, steps[path.views[-1]], positions):
                by_step.setdefault((path.views[-1], longer.views[-1]), []).append(longer)
        paths = [path for same_step in by_step.values() for path in sorted(same_step)[:BEAM]]
    return best


def path_triples(views: Sequence[int], between: Sequence[int]) -> list[tuple[int, int, int]]:
    """The triples of a path: two neighbouring views and the frame held out between them."""
    return [(a, b, target) for (a, b), target in zip(pairwise(views), between, strict=True)]


def _steps(cost: np.ndarray) -> list[tuple[float, int, int]]:
    """Cost, next view and held-out frame of the steps from a view; cost: of its triples, [frames, frames]."""
    order = np.argsort(cost, axis=1)[:, :TARGETS]
    return [(float(cost[b, t]), b, int(t)) for b, targets in enumerate(order) for t in targets if cost[b, t] < np.inf]


def _extended(path: ViewPath, steps: list[tuple[float, int, int]], positions: np.ndarray) -> list[ViewPath]:
    """The path with one more view each, ahead of the last step and not close to an earlier view."""
    used = {*path.views, *path.between}
    last, before = positions[path.views[-1]], positions[path.views[-2]]
    spacing = np.linalg.norm(positions[:, None] - positions[list(path.views)], axis=-1).min(axis=1)
    allowed = ((positions - last) @ (last - before) > 0) & (spacing >= MIN_SPACING * np.linalg.norm(last - before))
    return [
        ViewPath(path.cost + value, (*path.views, view), (*path.between, target))
        for value, view, target in steps
        if allowed[view] and not {view, target} & used
    ]


def _window_cost(path: ViewPath, cost: np.ndarray) -> float:
    """The mean over the windows of PATH_LENGTHS views, in the middle of the path, of the mean cost of their triples."""
    costs = [cost[triple] for triple in path_triples(path.views, path.between)]
    means = []
    for count in PATH_LENGTHS:
        if count <= len(path.views):
            first = window_start(len(path.views), count)
            means.append(np.mean(costs[first : first + count - 1]))
    return float(np.mean(means))
