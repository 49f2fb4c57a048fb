"""Fusion: Gaussians that other views see through are left out, and unseen ones stay."""

import numpy as np
from idesplat.runtime.splats.fusion import contradicted
from idesplat.runtime.splats.points import unproject

SIZE = 32
INTRINSICS = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])


def views_of_a_wall(count: int, distance: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, extrinsics and intrinsics of cameras side by side before a wall."""
    extrinsics = np.tile(np.eye(4), (count, 1, 1))
    extrinsics[:, 0, 3] = np.linspace(-0.5, 0.5, count)
    return np.full((count, SIZE, SIZE), distance), extrinsics, np.tile(INTRINSICS, (count, 1, 1))


def left_out(depth: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    return contradicted(unproject(depth, extrinsics, intrinsics), depth, extrinsics, intrinsics)


def test_views_that_agree_keep_everything() -> None:
    assert not left_out(*views_of_a_wall(4)).any()


def test_a_patch_in_front_of_what_two_views_see_is_left_out() -> None:
    depth, extrinsics, intrinsics = views_of_a_wall(3)
    depth[1, 10:20, 10:20] = 2.5
    found = left_out(depth, extrinsics, intrinsics)
    assert found[1, 10:20, 10:20].all()
    found[1, 10:20, 10:20] = False
    assert not found.any()


def test_of_two_views_that_contradict_each_other_both_stay() -> None:
    depth, extrinsics, intrinsics = views_of_a_wall(2)
    depth[1] = 2.5
    assert not left_out(depth, extrinsics, intrinsics).any()


def test_a_surface_that_hides_the_wall_from_all_views_stays() -> None:
    """A board that three views see in front of the wall: the wall is unseen behind it, not contradicted, nor is it."""
    depth, extrinsics, intrinsics = views_of_a_wall(3)
    for view in range(3):
        columns = (np.arange(SIZE) + 0.5) / SIZE - 0.5
        across = columns * 2.0 + extrinsics[view, 0, 3]
        depth[view][:, np.abs(across) < 0.3] = 2.0
    assert left_out(depth, extrinsics, intrinsics).mean() < 0.02  # the columns at the board's edges


def test_what_one_view_alone_sees_stays() -> None:
    depth, extrinsics, intrinsics = views_of_a_wall(3)
    turned = np.eye(4)
    turned[:3, :3] = np.diag([-1, 1, -1])  # looks the other way
    extrinsics[2] = turned @ extrinsics[2]
    assert not left_out(depth, extrinsics, intrinsics)[2].any()
