"""Depth corrected, and chosen, by stereo matching, on textured and plain planes that cameras beside each other see."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.rating import DepthRating
from idesplat.runtime.reconstruction.speckles import find_speckles
from idesplat.runtime.reconstruction.stereo import MIN_VIEWS, correct_depths
from idesplat.runtime.views.batch import ViewBatch
from views_in_a_row import prediction_of, views_in_a_row

VIEWS, HEIGHT, WIDTH = 5, 48, 128
PLANE, FOCAL, BASELINE = 4.0, 80.0, 0.5  # neighbours see the plane 10 pixels apart
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
INNER = (slice(6, -6), slice(44, -44))  # pixels that all views see, without those whose patch crosses the frame


def plane_views(count: int = VIEWS, textured: bool = True) -> ViewBatch:
    """Cameras beside each other before a plane of blurred noise, or of one colour."""
    shift = round(FOCAL * BASELINE / PLANE)
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH + shift * count)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.5) if textured else np.full_like(noise, 0.5)
    images = np.stack([wall[:, shift * view : shift * view + WIDTH] for view in range(count)])
    return views_in_a_row(np.repeat(images[:, None], 3, 1), BASELINE * np.arange(count), K)


def corrected(depth: np.ndarray, views: ViewBatch) -> Prediction:
    return correct_depths(prediction_of(depth, views), views, all_voters(len(views.names)))


def all_voters(count: int) -> list[np.ndarray]:
    """All views are asked about each, the nearest first."""
    return [np.array(sorted(set(range(count)) - {view}, key=lambda other: abs(other - view))) for view in range(count)]


def plane_depth(count: int = VIEWS) -> np.ndarray:
    return np.full((count, HEIGHT, WIDTH), PLANE, np.float32)


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.15, 1.3])
@pytest.mark.parametrize("count", [MIN_VIEWS, VIEWS])
def test_a_depth_that_the_images_speak_against_moves_to_where_they_match(count: int, factor: float) -> None:
    middle, depth = count // 2, plane_depth(count)
    depth[middle] *= factor
    done = corrected(depth, plane_views(count))
    error = np.abs(done.depth[middle] - PLANE)[INNER] / PLANE
    assert np.median(error) < 0.002
    assert (error < abs(factor - 1) / 2).mean() > 0.95


def test_right_depths_stay_exactly() -> None:
    done = corrected(plane_depth(), plane_views())
    np.testing.assert_array_equal(done.depth[(slice(None), *INNER)], PLANE)


def test_a_plain_surface_stays_where_no_view_contradicts() -> None:
    depth = plane_depth()
    depth[2] *= 1.01
    done = corrected(depth, plane_views(textured=False))
    np.testing.assert_array_equal(done.depth, depth)


def test_gaussians_move_along_their_rays_and_keep_their_size_in_the_image() -> None:
    depth, views = plane_depth(), plane_views()
    depth[2] *= 1.1
    done = corrected(depth, views)
    expected = prediction_of(done.depth, views).need_gaussians()
    gaussians = done.need_gaussians()
    np.testing.assert_allclose(gaussians.means, expected.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(gaussians.scales[:, 0], (done.depth / depth).ravel(), rtol=1e-6)


def test_two_views_stay_as_predicted() -> None:
    count = MIN_VIEWS - 1
    depth = plane_depth(count)
    depth[1] *= 1.01
    np.testing.assert_array_equal(corrected(depth, plane_views(count)).depth, depth)


def test_views_that_see_nothing_of_the_same_stay_as_predicted() -> None:
    views = plane_views()
    apart = views.extrinsics.copy()
    apart[:, 0, 3] *= 1000
    depth = plane_depth()
    depth[2] *= 1.01
    np.testing.assert_array_equal(corrected(depth, replace(views, extrinsics=apart)).depth, depth)


def test_images_without_any_match_leave_no_speckles() -> None:
    """Of noise some patches match by chance at the depth of another view's surface."""
    views = plane_views()
    noise = np.random.default_rng(1).random(views.images.shape).astype(np.float32)
    depth = plane_depth() * np.float32([0.8, 0.9, 1, 1.1, 1.2])[:, None, None]
    done = corrected(depth, replace(views, images=noise))
    moved = np.abs(done.depth - depth) > 1e-5
    assert moved.any()
    speckles = np.stack([find_speckles(view) for view in done.depth])
    assert not (moved & speckles).any()


def test_of_depths_that_all_views_agree_with_the_images_choose() -> None:
    """The surfaces of the other views agree with both within their tolerance."""
    views = plane_views()
    contrasty = replace(views, images=0.5 + 4 * (views.images - 0.5))
    rating = DepthRating(plane_depth(), contrasty, all_voters(VIEWS))
    right, near = (Prediction(factor * plane_depth(1), None) for factor in (1, 0.96))
    for predictions in ([right, near], [near, right]):
        assert (rating.best(2, predictions).depth[0][INNER] == PLANE).mean() > 0.99
