"""Groups of views: more views than the network takes at once, in overlapping groups of those that see the same."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..cameras.camera import Camera
from .selection import score_pairs


@dataclass(frozen=True)
class ViewGroup:
    """Views that the network gets together, in rising order, and those of them whose prediction is used."""

    views: tuple[int, ...]
    used: tuple[int, ...]


def group_views(cameras: Sequence[Camera], depths: np.ndarray, size: int) -> list[ViewGroup]:
    """Groups of at most `size` views so that each view is used once, beside the views that suit it best.

    A group grows from a view that has none yet: by the views without a group that make the best pairs with its own,
    and then by the best partner that each of these lacks. depths: of the scene in each camera, [cameras].
    """
    count = len(cameras)
    if count <= size:
        return [ViewGroup(tuple(range(count)), tuple(range(count)))]
    cost = score_pairs(cameras, depths).cost
    np.fill_diagonal(cost, np.inf)
    partners = cost.argmin(axis=1)
    left, groups = set(range(count)), []
    while left:
        used = _grow(cost, left, max(2, size - size // 3))
        left -= set(used)
        lacking = [int(partners[view]) for view in used if partners[view] not in used]
        views = [*used, *dict.fromkeys(lacking)][:size]
        if len(views) == 1:
            views.append(int(partners[views[0]]))
        groups.append(ViewGroup(tuple(sorted(views)), tuple(sorted(used))))
    return groups


def nearest_views(cameras: Sequence[Camera], depths: np.ndarray, count: int) -> list[np.ndarray]:
    """The views that make the best pairs with each view, at most `count`, [cameras] arrays of indices."""
    cost = score_pairs(cameras, depths).cost
    np.fill_diagonal(cost, np.inf)
    order = np.argsort(cost, axis=1, kind="stable")[:, : min(count, len(cameras) - 1)]
    return [row[np.isfinite(cost[view, row])] for view, row in enumerate(order)]


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
