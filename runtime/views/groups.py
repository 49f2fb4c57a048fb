"""Groups of views: more views than the network takes at once, in overlapping groups of those that see the same."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from .selection import score_pairs

# Up to so many views, each gets a group of its own, with its best partners. That takes up to three times as long; pairs
# add at most one prediction of two views for each view.
OWN_GROUPS = 24
# Of a pair, beyond which a view makes the depth of a group of its own worse instead of better: a parallax of 25 degrees
# at an overlap of 80 %, or of 10 degrees at 50 %.
MAX_COST = 3.0
NO_OVERLAP = 1e6  # more than the cost of any pair that sees something in common
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class ViewGroup:
    """Views that the network gets together, in rising order.

    used: those of them whose own group this is. What it predicts of the others is only chosen where it is better.
    """

    views: tuple[int, ...]
    used: tuple[int, ...]


def group_views(cameras: Sequence[Camera], depths: np.ndarray, size: int, pairs: bool = False) -> list[ViewGroup]:
    """Groups of at most `size` views so that each view is used once, beside the views that suit it best.

    Up to OWN_GROUPS views, each is grouped with its best partner and others up to MAX_COST, and equal groups are one.
    Of more views, a group grows from a view that has none yet: by the views without a group that make the best pairs
    with its own, and then by the best partner that each of these lacks. Where there is no room for that, the view waits
    for the next group.
    size: 3 or more. depths: of the scene in each camera, [cameras]. pairs: whether up to OWN_GROUPS views also form
    groups of each view and its best partner alone: a third view that sees little of a surface makes its depth worse.
    """
    count = len(cameras)
    cost = _pair_costs(cameras, depths)
    if count <= size:
        groups = [ViewGroup(tuple(range(count)), tuple(range(count)))]
    elif count <= OWN_GROUPS:
        groups = _own_groups(cost, size)
    else:
        return _shared_groups(cost, size)
    return [*groups, *_best_pairs(cost, groups)] if pairs else groups


def _shared_groups(cost: np.ndarray, size: int) -> list[ViewGroup]:
    """Groups of at most `size` views that several views share as their own."""
    partners = cost.argmin(axis=1)
    left, groups = set(range(len(cost))), []
    while left:
        members = _grow(cost, left, max(2, size - size // 3))
        lacking = dict.fromkeys(int(partners[view]) for view in members if partners[view] not in members)
        views = [*members, *lacking][:size]
        used = [view for view in members if partners[view] in views]  # the first one at least: `size` is above 2
        left -= set(used)
        groups.append(ViewGroup(tuple(sorted(views)), tuple(sorted(used))))
    return groups


def _own_groups(cost: np.ndarray, size: int) -> list[ViewGroup]:
    """The group of each view and up to `size` - 1 others that make good pairs with it; equal groups are one."""
    used: dict[tuple[int, ...], list[int]] = {}
    for view, (best, *others) in enumerate(_best_partners(cost, size - 1).tolist()):
        good = [other for other in others if cost[view, other] <= MAX_COST]
        used.setdefault(tuple(sorted({view, best, *good})), []).append(view)
    return [ViewGroup(views, tuple(own)) for views, own in used.items()]


def _best_pairs(cost: np.ndarray, groups: Sequence[ViewGroup]) -> list[ViewGroup]:
    """The pairs of each view and its best partner that are no group yet, as groups that are no view's own."""
    pairs = {(min(view, best), max(view, best)) for view, best in enumerate(cost.argmin(axis=1).tolist())}
    return [ViewGroup(pair, ()) for pair in sorted(pairs - {group.views for group in groups})]


def nearest_views(cameras: Sequence[Camera], depths: np.ndarray, count: int) -> list[np.ndarray]:
    """The views that make the best pairs with each view, at most `count`, [cameras] arrays of indices."""
    return list(_best_partners(_pair_costs(cameras, depths), min(count, len(cameras) - 1)))


def _best_partners(cost: np.ndarray, count: int) -> np.ndarray:
    """The `count` views of the lowest cost beside each view, best first, [cameras, count]."""
    return np.argsort(cost, axis=1, kind="stable")[:, :count]


def _pair_costs(cameras: Sequence[Camera], depths: np.ndarray) -> np.ndarray:
    """The cost of every pair, [cameras, cameras], finite but for the diagonal: without overlap the distance decides."""
    cost = score_pairs(cameras, depths).cost
    positions = np.stack([camera.extrinsics[:3, 3] for camera in cameras])
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    cost = np.where(np.isfinite(cost), cost, NO_OVERLAP * (1 + distance / max(distance.max(), TINY)))
    np.fill_diagonal(cost, np.inf)
    return cost


def _grow(cost: np.ndarray, left: set[int], size: int) -> list[int]:
    """Up to `size` of the views in `left`: the first, and then always the one that pairs best with one of these."""
    members = [min(left)]
    rest = left - set(members)
    while rest and len(members) < size:
        candidates = sorted(rest)
        best = candidates[int(cost[np.ix_(members, candidates)].min(axis=0).argmin())]
        members.append(best)
        rest.remove(best)
    return members
