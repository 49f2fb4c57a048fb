"""Selection of triples and of a path of views from a survey."""

import numpy as np

from .capture import MAX_VIEWS
from .survey import Survey

TRIPLES = 3
BASELINE = 0.25  # of a triple, over the depth of what it sees
MIN_BASELINE = 0.08
MAX_ASIDE = 0.7  # how far a held-out frame stands from the line between its neighbours, in baselines
MIN_ALONG, MAX_ALONG = 0.2, 0.8  # where it stands along that line
MIN_SPACING = 0.4  # baselines: views of a path stand farther from each other
STARTS = 60
TINY = 1e-3


def triple_costs(
    positions: np.ndarray, survey: Survey, good: np.ndarray, least_overlap: float, largest_baseline: float
) -> np.ndarray:
    """The cost of each triple (first, second, target), infinite where not allowed, [frames, frames, frames].

    It adds |log2| of the baseline over `BASELINE`, the target's distance from the middle, and -log2 of the overlap."""
    count = len(positions)
    cost = np.full((count, count, count), np.inf)
    for a in good:
        for b in good[good > a]:
            ratio = survey.baseline[a, b]
            if not MIN_BASELINE <= ratio <= largest_baseline or survey.overlap[a, b] < least_overlap:
                continue
            way = positions[b] - positions[a]
            along = (positions[good] - positions[a]) @ way / (way @ way)
            aside = np.linalg.norm(positions[good] - positions[a] - along[:, None] * way, axis=1) / np.linalg.norm(way)
            overlap = np.minimum(survey.overlap[a, b], np.minimum(survey.overlap[a, good], survey.overlap[b, good]))
            off_middle = 2 * np.abs(along - 0.5) + aside
            found = np.abs(np.log2(ratio / BASELINE)) + off_middle - np.log2(np.maximum(overlap, TINY))
            allowed = (along > MIN_ALONG) & (along < MAX_ALONG) & (aside < MAX_ASIDE) & (overlap >= least_overlap)
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


def longest_path(cost: np.ndarray, positions: np.ndarray, survey: Survey) -> tuple[list[int], list[int]]:
    """The path of most views, with a held-out frame between each two, that starts at one of the better triples.

    No views where there is no triple.
    """
    best = np.unique(cost[np.isfinite(cost)])[:STARTS]
    paths: list[tuple[int, float, list[int], list[int]]] = [(0, 0.0, [], [])]
    for value in best:
        a, b, target = (int(i[0]) for i in np.nonzero(cost == value))
        views, between = [a, b], [target]
        while len(views) < MAX_VIEWS and _extend(views, between, cost, positions):
            pass
        steps = [cost[first, second, held] for first, second, held in zip(views, views[1:], between, strict=False)]
        paths.append((-len(views), float(np.mean(steps)), views, between))
    _, _, views, between = min(paths)
    return views, between


def _extend(views: list[int], between: list[int], cost: np.ndarray, positions: np.ndarray) -> bool:
    """Add the best next view and held-out frame at either end of the path; False if there is none."""
    best = (np.inf, 0, 0, False)
    for end, previous, at_front in ((views[-1], views[-2], False), (views[0], views[1], True)):
        options = cost[end].copy()  # [view, target]
        options[:, [*views, *between]] = np.inf
        options[between] = np.inf
        step = np.linalg.norm(positions[end] - positions[previous])
        distance = np.linalg.norm(positions[:, None] - positions[views], axis=-1).min(axis=1)
        options[distance < MIN_SPACING * step] = np.inf
        onward = (positions - positions[end]) @ (positions[end] - positions[previous]) > 0
        options[~onward] = np.inf
        view, target = (int(i) for i in np.unravel_index(options.argmin(), options.shape))
        if options[view, target] < best[0]:
            best = (float(options[view, target]), view, target, at_front)
    value, view, target, at_front = best
    if not np.isfinite(value):
        return False
    views.insert(0 if at_front else len(views), view)
    between.insert(0 if at_front else len(between), target)
    return True
