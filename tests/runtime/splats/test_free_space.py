"""Gaussians in the free space before cameras are found; those of surfaces, or out of sight, are not."""

import numpy as np
import pytest
from idesplat.runtime.splats.free_space import FREE, MARGIN, REACH, find_in_free_space
from views_in_a_row import extrinsics_in_a_row

SURFACE = 2.0  # depth of a wall that all views see
FREE_DEPTH = FREE * SURFACE
INTRINSICS = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], np.float32)  # sees up to half a depth aside
SIDE = 20


def found(points: list[tuple[float, float, float]], *positions: float, nearer: int = 0) -> list[bool]:
    """Which points are found by views at positions on the x axis that look along z at the wall.

    nearer: how many pixels of each view have a hundredth of the wall's depth.
    """
    extrinsics = extrinsics_in_a_row(*positions)
    depth = np.full((len(positions), SIDE, SIDE), SURFACE, np.float32)
    depth.reshape(len(positions), -1)[:, :nearer] = SURFACE / 100
    intrinsics = np.tile(INTRINSICS, (len(positions), 1, 1))
    return find_in_free_space(np.float32(points), depth, extrinsics, intrinsics).tolist()


def test_what_is_right_before_a_camera_is_found_up_to_half_the_depth_of_its_nearest_surface() -> None:
    assert found([(0, 0, 0.99 * FREE_DEPTH), (0, 0, 1.01 * FREE_DEPTH), (0, 0, SURFACE)], 0.0) == [True, False, False]


def test_what_no_camera_has_in_sight_stays() -> None:
    seen = (0.5 + MARGIN) * 0.5  # aside of the axis, at a depth of 0.5
    assert found([(0.99 * seen, 0, 0.5), (1.01 * seen, 0, 0.5), (0, -1.01 * seen, 0.5)], 0.0) == [True, False, False]
    assert found([(0, 0, -0.5)], 0.0) == [False]


@pytest.mark.parametrize("distance", [0.4 * SURFACE, 0.99 * REACH * SURFACE])
def test_what_is_right_before_a_camera_between_neighbours_is_found(distance: float) -> None:
    point = (distance / 2, 0, distance / 6)  # in the middle, outside the images of both
    assert found([point], 0.0, distance) == [True]
    assert found([point], 0.0) == [False]


def test_views_far_apart_are_not_joined() -> None:
    distance = 1.01 * REACH * SURFACE
    assert found([(distance / 2, 0, 0.1)], 0.0, distance) == [False]


def test_a_few_pixels_of_a_wrong_depth_do_not_decide() -> None:
    pixels = SIDE * SIDE
    points = [(0.0, 0, 0.9 * FREE_DEPTH)]
    assert found(points, 0.0, nearer=pixels // 200) == [True]
    assert found(points, 0.0, nearer=pixels // 20) == [False]


def test_the_unit_of_the_scene_cancels() -> None:
    rng = np.random.default_rng(0)
    means = rng.uniform([-0.5, -0.5, 0], [2.5, 0.5, 2], (500, 3))
    extrinsics = extrinsics_in_a_row(0, 0.5, 2)
    depth, intrinsics = rng.uniform(1.5, 3, (3, SIDE, SIDE)), np.tile(INTRINSICS, (3, 1, 1))
    once = find_in_free_space(means.astype(np.float32), depth, extrinsics, intrinsics)
    extrinsics[:, :3, 3] *= 8
    again = find_in_free_space((8 * means).astype(np.float32), 8 * depth, extrinsics, intrinsics)
    assert 10 < once.sum() < 400
    np.testing.assert_array_equal(once, again)
