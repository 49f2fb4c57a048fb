"""Speckles are the small surfaces that depth jumps around; what is large, or follows its neighbours, is none."""

import numpy as np
from idesplat.runtime.reconstruction.speckles import JUMP, LARGEST, find_speckles

HEIGHT, WIDTH = 24, 40
PLANE = 3.0


def plane_with(patch: tuple[slice, slice], depth: float) -> np.ndarray:
    plane = np.full((HEIGHT, WIDTH), PLANE, np.float32)
    plane[patch] = depth
    return plane


def marked(patch: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[patch] = True
    return mask


def test_the_largest_speckle_is_found_before_and_behind_its_surface() -> None:
    patch = slice(4, 8), slice(10, 15)
    assert marked(patch).sum() == LARGEST
    for depth in (PLANE / 2, PLANE * 1.1, PLANE * 1e4):
        np.testing.assert_array_equal(find_speckles(plane_with(patch, depth)), marked(patch))


def test_an_object_is_no_speckle() -> None:
    assert not find_speckles(plane_with((slice(4, 7), slice(10, 17)), PLANE / 2)).any()


def test_a_thin_line_is_no_speckle() -> None:
    assert not find_speckles(plane_with((slice(0, HEIGHT), slice(10, 11)), PLANE / 2)).any()


def test_a_surface_may_recede_without_a_jump() -> None:
    row = PLANE * (1 + JUMP / 2) ** np.arange(WIDTH, dtype=np.float32)
    assert not find_speckles(np.tile(row, (HEIGHT, 1))).any()


def test_two_speckles_of_one_depth_are_two() -> None:
    patches = marked((slice(2, 6), slice(3, 8))) | marked((slice(2, 6), slice(20, 25)))
    depth = np.where(patches, PLANE * 2, PLANE).astype(np.float32)
    np.testing.assert_array_equal(find_speckles(depth), patches)
