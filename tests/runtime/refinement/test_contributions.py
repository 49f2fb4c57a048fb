"""Contributions of Gaussians to the views: summed over the last complete round, unknown where nothing was seen."""

import numpy as np
from idesplat.runtime.refinement.contributions import UNSEEN, Contributions, strongest


def one_view(weights: dict[int, float], in_sight: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """A view of four Gaussians: their weights, and which are in sight."""
    total, seen = np.zeros(4), np.zeros(4, bool)
    total[list(weights)] = list(weights.values())
    seen[in_sight] = True
    return total, seen


def test_sums_over_the_views_of_a_round() -> None:
    contributions = Contributions(4, views=2)
    contributions.add(*one_view({0: 1.0, 1: 0.5}, [0, 1, 2]))
    contributions.add(*one_view({0: 2.0}, [0]))
    np.testing.assert_array_equal(contributions.total, [3, 0.5, 0, UNSEEN])


def test_a_round_that_has_begun_does_not_count_after_a_complete_one() -> None:
    contributions = Contributions(4, views=2)
    for weight in (1.0, 2.0, 5.0):
        contributions.add(*one_view({0: weight}, [0]))
    np.testing.assert_array_equal(contributions.total, [3, UNSEEN, UNSEEN, UNSEEN])
    contributions.add(*one_view({1: 1.0}, [1]))
    np.testing.assert_array_equal(contributions.total, [5, 1, UNSEEN, UNSEEN])


def test_keeps_the_chosen_gaussians() -> None:
    contributions = Contributions(4, views=1)
    contributions.add(*one_view({0: 1.0, 2: 4.0, 3: 2.0}, [0, 1, 2, 3]))
    chosen = strongest(contributions.total, 2)
    np.testing.assert_array_equal(chosen, [2, 3])
    contributions.keep(chosen)
    np.testing.assert_array_equal(contributions.total, [4, 2])


def test_what_adds_nothing_is_not_among_the_strongest() -> None:
    np.testing.assert_array_equal(strongest(np.array([0, UNSEEN, 0.1]), 3), [1, 2])


def test_what_views_show_is_kept_before_what_none_has_in_sight() -> None:
    np.testing.assert_array_equal(strongest(np.array([UNSEEN, 1e-9, UNSEEN, 2.0]), 2), [1, 3])
