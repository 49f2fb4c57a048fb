"""Contributions of Gaussians to the views: summed over the last complete round, unknown where nothing was seen."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from idesplat.runtime.refinement.contributions import Contributions, strongest
from idesplat.runtime.refinement.kernels import ENTRY, WEIGHT


def one_pass(weights: dict[int, float], in_sight: list[int]) -> tuple[Any, np.ndarray]:
    """A pass over four Gaussians with one entry for each weight."""
    gradients, boxes = np.zeros((len(weights), ENTRY)), np.zeros((4, 4), np.int32)
    gradients[:, WEIGHT] = list(weights.values())
    boxes[in_sight, 3] = 1
    found = SimpleNamespace(gaussians=np.array(list(weights), int), entries=np.arange(len(weights)), boxes=boxes)
    return found, gradients


def test_sums_over_the_views_of_a_round() -> None:
    contributions = Contributions(4, views=2)
    contributions.add(*one_pass({0: 1.0, 1: 0.5}, [0, 1, 2]))
    contributions.add(*one_pass({0: 2.0}, [0]))
    np.testing.assert_array_equal(contributions.total, [3, 0.5, 0, np.inf])


def test_a_round_that_has_begun_does_not_count_after_a_complete_one() -> None:
    contributions = Contributions(4, views=2)
    for weight in (1.0, 2.0, 5.0):
        contributions.add(*one_pass({0: weight}, [0]))
    np.testing.assert_array_equal(contributions.total, [3, np.inf, np.inf, np.inf])
    contributions.add(*one_pass({1: 1.0}, [1]))
    np.testing.assert_array_equal(contributions.total, [5, 1, np.inf, np.inf])


def test_keeps_the_chosen_gaussians() -> None:
    contributions = Contributions(4, views=1)
    contributions.add(*one_pass({0: 1.0, 2: 4.0, 3: 2.0}, [0, 1, 2, 3]))
    chosen = strongest(contributions.total, 2)
    np.testing.assert_array_equal(chosen, [2, 3])
    contributions.keep(chosen)
    np.testing.assert_array_equal(contributions.total, [4, 2])


def test_what_adds_nothing_is_not_among_the_strongest() -> None:
    np.testing.assert_array_equal(strongest(np.array([0, np.inf, 0.1]), 3), [1, 2])
