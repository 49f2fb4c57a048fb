"""How much each Gaussian contributes to the views, from the steps of a refinement."""

import numpy as np

# The contribution of a Gaussian that no view had in sight: less than of any that a view shows, but not nothing.
UNSEEN = np.finfo(np.float64).tiny


class Contributions:
    """The sum of alpha T over the pixels of the views, one view a step, in rounds of all views.

    It costs no rendering of its own: the backward pass of each step finds the weights.
    """

    def __init__(self, gaussians: int, views: int) -> None:
        self.views = views
        self._round, self._last = _Round(gaussians), _Round(gaussians)

    @property
    def total(self) -> np.ndarray:
        """Of the last round, if it is not the first, complete; UNSEEN where no view had a Gaussian in sight."""
        latest = self._round if self._round.steps == self.views or not self._last.steps else self._last
        return np.where(latest.seen, latest.total, UNSEEN)

    def add(self, weights: np.ndarray, seen: np.ndarray) -> None:
        """Add a view: the Gaussians' weights in it, and whether it has them in sight, both [gaussians]."""
        if self._round.steps == self.views:
            self._last, self._round = self._round, _Round(len(self._round.total))
        self._round.total += weights
        self._round.seen |= seen
        self._round.steps += 1

    def keep(self, chosen: np.ndarray) -> None:
        """Keep the Gaussians with these indices."""
        for part in (self._round, self._last):
            part.total, part.seen = part.total[chosen], part.seen[chosen]


class _Round:
    def __init__(self, gaussians: int) -> None:
        self.total = np.zeros(gaussians)
        self.seen = np.zeros(gaussians, bool)
        self.steps = 0


def strongest(contributions: np.ndarray, count: int) -> np.ndarray:
    """The indices of the Gaussians that contribute most, at most `count`, in rising order; none that adds nothing."""
    order = np.argsort(-contributions, kind="stable")[:count]
    return np.sort(order[contributions[order] > 0])
