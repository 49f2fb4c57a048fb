"""Colours that follow the direction of view: what all views show of a surface, from where they show it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from idesplat.runtime.geometry.sh import SH_0, sh_basis
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.view_colors import fit_view_colors
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.batch import ViewBatch
from views_in_a_row import prediction_of, views_in_a_row

SIZE, WALL = 16, 2.0
K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
ALL_SEE = 0.9  # half the width of the part of the wall before the cameras that all of them see


def predicted(
    images: np.ndarray, positions: Sequence[float], coefficients: int, depth: np.ndarray | None = None
) -> tuple[Prediction, ViewBatch]:
    """Gaussians with the colours of their views' images, RGB [views, 3, SIZE, SIZE], on a wall or at another depth.

    positions: of the cameras, side by side.
    """
    views = views_in_a_row(images, positions, K)
    prediction = prediction_of(np.full((len(images), SIZE, SIZE), WALL) if depth is None else depth, views)
    gaussians = prediction.need_gaussians()
    sh = np.zeros((len(gaussians), coefficients, 3), np.float32)
    sh[:, 0] = (images.transpose(0, 2, 3, 1).reshape(-1, 3) - 0.5) / SH_0
    return replace(prediction, gaussians=replace(gaussians, sh=sh)), views


def fitted(prediction: Prediction, views: ViewBatch) -> Gaussians:
    others = [np.delete(np.arange(len(views.names)), view) for view in range(len(views.names))]
    return fit_view_colors(prediction, views, others).need_gaussians()


def seen_from(gaussians: Gaussians, position: np.ndarray) -> np.ndarray:
    """The colours of the Gaussians from a camera there, [gaussians, 3]."""
    directions = gaussians.means - position
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return 0.5 + np.einsum("gk,gkc->gc", sh_basis(directions, gaussians.sh.shape[1]), gaussians.sh)


def plain(*levels: float) -> np.ndarray:
    return np.tile(np.float32(levels)[:, None, None, None], (1, 3, SIZE, SIZE))


def common(gaussians: Gaussians, view: int) -> np.ndarray:
    """Indices of a view's Gaussians on the part of the wall that all views see."""
    inside = np.abs(gaussians.means[:, :2]).max(axis=1) < ALL_SEE
    return np.flatnonzero(inside & (np.arange(len(inside)) // SIZE**2 == view))


def test_without_directions_each_view_takes_the_mean_of_what_all_show() -> None:
    """For the first view, a^2 + (a - 0.1)^2 + (a - 0.5)^2 is least at 0.2."""
    gaussians = fitted(*predicted(plain(0.2, 0.3, 0.7), (-0.1, 0.0, 0.1), 1))
    for view in range(3):
        np.testing.assert_allclose(gaussians.colours[common(gaussians, view)], 0.4, atol=1e-5)


def test_a_shade_that_changes_with_the_direction_is_seen_from_each_view() -> None:
    """The wall is brighter from the right: every view's Gaussians show each camera nearly what its image shows."""
    positions, levels = (-0.9, -0.3, 0.3, 0.9), (0.35, 0.45, 0.55, 0.65)
    before, views = predicted(plain(*levels), positions, 4)
    after = fitted(before, views)
    for view in range(4):
        for position, level in zip(positions, levels, strict=True):
            seen = seen_from(after, np.array([position, 0, 0]))[common(after, view)]
            np.testing.assert_allclose(seen, level, atol=0.04)  # the views differ by 0.1 to 0.3


@pytest.mark.parametrize("coefficients", [9, 16])
def test_higher_degrees_stay(coefficients: int) -> None:
    before, views = predicted(plain(0.2, 0.3, 0.7), (-0.1, 0.0, 0.1), coefficients)
    before.need_gaussians().sh[:, 4:] = 0.25
    after = fitted(before, views)
    assert (after.sh[:, 4:] == 0.25).all() and (after.sh[:, 1:4] != 0).any()


def test_what_lies_elsewhere_or_has_a_very_different_colour_does_not_count() -> None:
    depth = np.full((3, SIZE, SIZE), WALL, np.float32)
    depth[2] *= 1.2
    before, views = predicted(plain(0.1, 0.9, 0.2), (-0.1, 0.0, 0.1), 4, depth)
    np.testing.assert_array_equal(fitted(before, views).sh, before.need_gaussians().sh)


def test_two_views_stay_as_they_are() -> None:
    before, views = predicted(plain(0.2, 0.3), (-0.1, 0.1), 4)
    assert fitted(before, views) is before.need_gaussians()
