"""Adam (Kingma and Ba 2015) for what belongs to one view: its exposure and its pose."""

from dataclasses import dataclass, field

import numpy as np

from .kernels import EPSILON
from .rasterizer import BETA_1, BETA_2


@dataclass(eq=False)
class ViewAdam:
    """Some numbers of each view, stepped when the view has its turn. visits: how often each had it."""

    views: int
    columns: int
    visits: np.ndarray = field(init=False)
    _moments: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self._moments = np.zeros((self.views, 2, self.columns))
        self.visits = np.zeros(self.views, int)

    def direction(self, view: int, gradient: np.ndarray) -> np.ndarray:
        """The step for a view at learning rate 1, to be subtracted; gradient: [columns]."""
        first, second = self._moments[view]
        first += (1 - BETA_1) * (gradient - first)
        second += (1 - BETA_2) * (gradient**2 - second)
        self.visits[view] += 1
        count = self.visits[view]
        step: np.ndarray = first / (1 - BETA_1**count) / (np.sqrt(second / (1 - BETA_2**count)) + EPSILON)
        return step
