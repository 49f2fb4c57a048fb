"""Fusion: what other views see through goes; what only one view sees, and what views agree on, stays."""

import numpy as np
import pytest
from idesplat.runtime.geometry.intrinsics import denormalize_intrinsics
from idesplat.runtime.splats.fusion import find_contradicted, find_redundant
from idesplat.runtime.splats.surfaces import Surfaces
from views_in_a_row import extrinsics_in_a_row

HEIGHT, WIDTH = 24, 32
WALL = 4.0
PATCH = (slice(8, 14), slice(10, 18))
K = np.array([[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]], np.float32)


def cameras(count: int) -> np.ndarray:
    """Cameras side by side that look at the wall, camera-to-world [views, 4, 4]."""
    return extrinsics_in_a_row(*(0.3 * np.arange(count)))


def unproject(depth: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = pixels @ np.linalg.inv(denormalize_intrinsics(K[None], WIDTH, HEIGHT)[0]).T
    return rays * depth[..., None] + extrinsics[:, None, None, :3, 3]


def contradicted(depth: np.ndarray) -> np.ndarray:
    return find_contradicted(surfaces(depth))


def surfaces(depth: np.ndarray, images: np.ndarray | None = None) -> Surfaces:
    extrinsics = cameras(len(depth))
    return Surfaces(unproject(depth, extrinsics), depth, extrinsics, np.tile(K, (len(depth), 1, 1)), images)


def wall(views: int) -> np.ndarray:
    return np.full((views, HEIGHT, WIDTH), WALL)


@pytest.mark.parametrize("views", [2, 3, 5])
def test_a_wall_that_all_views_agree_on_stays(views: int) -> None:
    assert not contradicted(wall(views)).any()


def test_a_patch_that_one_view_puts_before_the_wall_goes_and_nothing_else() -> None:
    depth = wall(4)
    depth[1][PATCH] = 2.0
    found = contradicted(depth)
    assert found[1][PATCH].mean() > 0.9
    found[1][PATCH] = False
    assert not found.any()


def test_a_patch_that_most_views_see_stays_and_the_one_that_sees_through_it_loses_nothing_before_it() -> None:
    """A real object before the wall: the view that misses it has its wall behind, which nothing contradicts."""
    depth = wall(4)
    for view in (0, 1, 2):
        shift = round(0.3 * view * WIDTH * float(K[0, 0]) / 2.0)
        depth[view][PATCH[0], PATCH[1].start - shift + 4 : PATCH[1].stop - shift + 4] = 2.0
    found = contradicted(depth)
    for view in (0, 1, 2):
        assert found[view][depth[view] == 2.0].mean() < 0.2


def test_what_only_one_view_sees_stays() -> None:
    """A point outside the other images, and one hidden behind the wall of the others, are unseen, not contradicted."""
    depth = wall(3)
    depth[0, :, :3] = 1.0
    depth[2][PATCH] = 9.0
    found = contradicted(depth)
    assert not found[0, :, :3].any()
    assert not found[2][PATCH].any()


def test_a_point_of_another_colour_than_the_surface_at_its_place_goes() -> None:
    """Pixels beside an edge that got the depth of the surface behind it: all depths agree, the colours do not."""
    depth = wall(4)
    images = np.full((4, 3, HEIGHT, WIDTH), 0.3, np.float32)
    images[1, :, PATCH[0], PATCH[1]] = 0.9
    found = find_contradicted(surfaces(depth, images))
    assert found[1][PATCH].mean() > 0.9
    found[1][PATCH] = False
    assert not found.any()


@pytest.mark.parametrize(
    ("colour", "same_color", "goes"),
    [(0.3, 1.0, True), (0.3, 0.25, False), (0.9, 0.25, True)],
    ids=["of the wall", "of the wall, which counts a quarter", "another"],
)
def test_a_view_that_sees_through_a_point_of_the_same_colour_may_count_less(
    colour: float, same_color: float, goes: bool
) -> None:
    """The third view supports the wall that the second sees behind the patch, and does not see the patch itself."""
    depth, extrinsics = wall(3), cameras(3)
    depth[0][PATCH] = WALL / 2
    extrinsics[2, 0, 3] = -1.5
    images = np.full((3, 3, HEIGHT, WIDTH), 0.3, np.float32)
    images[0, :, PATCH[0], PATCH[1]] = colour
    views = Surfaces(unproject(depth, extrinsics), depth, extrinsics, np.tile(K, (3, 1, 1)), images)
    assert (find_contradicted(views, same_color)[0][PATCH].mean() > 0.9) == goes


def test_colours_within_fine_texture_agree() -> None:
    """Each view samples stripes of one pixel elsewhere."""
    images = np.full((4, 3, HEIGHT, WIDTH), 0.1, np.float32)
    images[..., ::2] = 0.9
    assert not find_contradicted(surfaces(wall(4), images)).any()


def test_the_two_views_in_the_middle_stay_and_of_the_others_what_these_do_not_see() -> None:
    depth = wall(4)
    everything = np.ones(depth.shape, bool)
    redundant = find_redundant(surfaces(depth), everything, 2)
    assert not redundant[1:3].any()
    shift = int(0.3 * WIDTH * float(K[0, 0]) / WALL) + 1  # pixels from view to view
    assert redundant[0, :, 2 * shift :].all() and redundant[3, :, : WIDTH - 2 * shift].all()
    assert not redundant[0, :, : shift - 1].any() and not redundant[3, :, WIDTH - shift + 1 :].any()


def test_what_is_removed_counts_as_no_copy() -> None:
    kept = np.ones((4, HEIGHT, WIDTH), bool)
    kept[1] = False
    redundant = find_redundant(surfaces(wall(4)), kept, 2)
    assert not redundant[:3].any() and redundant[3].any()


def test_a_point_that_most_views_disagree_with_goes_even_if_no_view_supports_theirs() -> None:
    """Four views have the wall at four depths, so that nothing is supported: the nearest one goes."""
    found = contradicted(wall(4) * np.array([0.5, 0.75, 0.9, 1.1])[:, None, None])
    seen_by_others = slice(5, None)  # columns
    assert found[0, :, seen_by_others].all()
    assert not found[3].any()


def test_of_three_views_two_do_not_outvote_the_third() -> None:
    assert not contradicted(wall(3) * np.array([0.5, 0.75, 0.9])[:, None, None]).any()


def test_a_point_that_most_views_disagree_with_stays_where_no_other_view_covers_its_pixel() -> None:
    """The depths of the test before, but the points of all other views lie behind the cameras."""
    depth, extrinsics = wall(4) * np.array([0.5, 0.75, 0.9, 1.1])[:, None, None], cameras(4)
    points = unproject(depth, extrinsics)
    points[1:, ..., 2] *= -1
    found = find_contradicted(Surfaces(points, depth, extrinsics, np.tile(K, (4, 1, 1))))
    assert not found[0].any()


def test_a_point_that_hides_the_surfaces_of_many_views_goes_even_if_its_pixel_is_left_empty() -> None:
    """As in the test before, with six others that see their wall behind the first one, and with five."""
    for views, goes in ((7, True), (6, False)):
        depth, extrinsics = wall(views) * np.linspace(0.5, 1.5, views)[:, None, None], cameras(views) * 1.0
        extrinsics[:, 0, 3] *= 0.1  # near each other, so that all see the same
        points = unproject(depth, extrinsics)
        points[1:, ..., 2] *= -1
        found = find_contradicted(Surfaces(points, depth, extrinsics, np.tile(K, (views, 1, 1))))
        assert found[0, HEIGHT // 2, WIDTH // 2] == goes


def test_a_nearer_view_of_a_surface_stays() -> None:
    """It samples the surface more finely than those that stand farther away."""
    extrinsics = cameras(3) * 1.0
    extrinsics[:2, 2, 3] = -WALL
    depth = wall(3)
    depth[:2] = 2 * WALL
    found = Surfaces(unproject(depth, extrinsics), depth, extrinsics, np.tile(K, (3, 1, 1)))
    assert not find_redundant(found, np.ones(depth.shape, bool), 2).any()
