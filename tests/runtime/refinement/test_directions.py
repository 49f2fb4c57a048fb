"""The mean directions from which views see Gaussians, and how far they spread: values worked out by hand."""

import numpy as np
from idesplat.runtime.geometry.rigid import invert_rigid
from idesplat.runtime.refinement.directions import LEAST_SPREAD, view_directions
from idesplat.runtime.refinement.rasterizer import Target
from views_in_a_row import extrinsics_in_a_row

K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])  # of 16 pixels: the image ends at 45 degrees


def views_from(*positions: float) -> list[Target]:
    """Views along z from places on the x axis."""
    return [Target(invert_rigid(pose), K, 16, 16) for pose in extrinsics_in_a_row(*positions)]


def test_mean_and_spread_of_two_views() -> None:
    """Directions (1, 0, 2) and (-1, 0, 2) over sqrt(5): their mean is 2 / sqrt(5) along z, each 1 / sqrt(5) from it."""
    found = view_directions(np.float32([[0, 0, 2]]), views_from(-1, 1))
    np.testing.assert_allclose(found.means, [[0, 0, 2 / np.sqrt(5)]], atol=1e-6)
    np.testing.assert_allclose(found.spread, 1 / np.sqrt(5), rtol=1e-6)


def test_views_count_that_have_a_gaussian_in_their_images() -> None:
    """The third camera has the first point outside its image, the second one is in its image alone."""
    points = np.float32([[0, 0, 2], [9, 0, 2], [0, 0, -2]])
    found = view_directions(points, views_from(-1, 1, 9))
    np.testing.assert_allclose(found.means, [[0, 0, 2 / np.sqrt(5)], [0, 0, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(found.spread, 1 / np.sqrt(5), rtol=1e-6)


def test_one_view_and_views_from_one_place_have_the_least_spread() -> None:
    point = np.float32([[0.3, 0.2, 2]])
    assert view_directions(point, views_from(0)).spread == LEAST_SPREAD
    assert view_directions(point, views_from(0, 0)).spread == LEAST_SPREAD
    assert not view_directions(point, views_from(0)).means.any()


def test_a_scene_without_gaussians_has_the_least_spread() -> None:
    found = view_directions(np.zeros((0, 3), np.float32), views_from(-1, 1))
    assert found.means.shape == (0, 3) and found.spread == LEAST_SPREAD
