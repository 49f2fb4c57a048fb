"""Groups of views: each view is used once, beside the views that suit it, and no group is too large."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.views.groups import group_views, nearest_views

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def along(positions: np.ndarray) -> list[Camera]:
    """Cameras at these x positions that look at a wall at depth 10."""
    cameras = []
    for index, x in enumerate(positions):
        pose = np.eye(4)
        pose[0, 3] = x
        cameras.append(Camera(f"{index}.png", 320, 240, K, pose))
    return cameras


def groups_of(positions: np.ndarray, size: int):
    return group_views(along(positions), np.full(len(positions), 10.0), size)


@given(st.integers(2, 40), st.integers(3, 9), st.integers(0, 1000))
def test_each_view_is_used_once_in_a_group_of_two_or_more(count: int, size: int, seed: int) -> None:
    positions = np.random.default_rng(seed).permutation(np.arange(count) * 0.8)
    groups = groups_of(positions, size)
    assert sorted(view for group in groups for view in group.used) == list(range(count))
    for group in groups:
        assert set(group.used) <= set(group.views) and list(group.views) == sorted(group.views)
        assert 2 <= len(group.views) <= size


def test_few_views_are_one_group() -> None:
    (group,) = groups_of(np.arange(6) * 0.8, 6)
    assert group.views == group.used == (0, 1, 2, 3, 4, 5)


def test_each_view_is_also_in_a_pair_with_its_best_partner() -> None:
    """Of three views in a row the middle one is the partner of both others; a pair that is a group is no second one."""
    three = group_views(along(np.array([0.0, 0.8, 1.7])), np.full(3, 10.0), 3, pairs=True)
    assert [(group.views, group.used) for group in three] == [((0, 1, 2), (0, 1, 2)), ((0, 1), ()), ((1, 2), ())]
    (two,) = group_views(along(np.array([0.0, 0.8])), np.full(2, 10.0), 3, pairs=True)
    assert two.views == two.used == (0, 1)
    aside = group_views(along(np.array([0.0, 0.8, 1.6, 2.4, 9.0])), np.full(5, 10.0), 3, pairs=True)
    assert [group.used for group in aside if group.views == (3, 4)] == [(4,)]
    many = along(np.arange(25) * 0.8)
    assert group_views(many, np.full(25, 10.0), 3, pairs=True) == group_views(many, np.full(25, 10.0), 3)


def test_each_of_eight_views_is_beside_its_two_best_partners() -> None:
    """Along a path those are its neighbours, or at an end the next two; 25 views share groups."""
    positions = np.random.default_rng(0).permutation(np.arange(8) * 0.8)
    rank = np.argsort(np.argsort(positions))
    groups = groups_of(positions, 3)
    for group in groups:
        for view in group.used:
            middle = min(max(rank[view], 1), 6)
            assert {rank[other] for other in group.views} == {middle - 1, middle, middle + 1}
    assert len(groups) == 6 and len(groups_of(np.arange(24) * 0.8, 3)) == 22
    assert len(groups_of(np.arange(25) * 0.8, 3)) < 20


def test_a_view_far_aside_is_in_no_group_but_its_own() -> None:
    """Depth is worse beside a view that sees little of the same. Its own group is a pair: none is predicted alone."""
    groups = groups_of(np.array([0.0, 0.8, 1.6, 2.4, 9.0]), 3)
    aside = [group for group in groups if 4 in group.views]
    assert [(group.views, group.used) for group in aside] == [((3, 4), (4,))]
    assert all(len(group.views) == 3 for group in groups if group not in aside)


@pytest.mark.parametrize("size", [4, 6])
def test_a_view_is_beside_its_best_partner(size: int) -> None:
    """Along a path, in any order of the images, each used view has one of its two neighbours in the group."""
    positions = np.random.default_rng(0).permutation(np.arange(24) * 0.8)
    for group in groups_of(positions, size):
        for view in group.used:
            distances = [abs(positions[view] - positions[other]) for other in group.views if other != view]
            assert min(distances) == pytest.approx(0.8)


def test_the_nearest_views_see_the_same() -> None:
    """Two walls back to back: no view is near one that looks the other way."""
    front, back = along(np.arange(4) * 0.8), along(np.arange(4) * 0.8)
    for camera in back:
        camera.extrinsics[:3, :3] = np.diag([-1.0, 1, -1])
    near = nearest_views([*front, *back], np.full(8, 10.0), 3)
    for view, others in enumerate(near):
        assert len(others) >= 2 and all((other < 4) == (view < 4) for other in others[:2])


def test_views_without_overlap_are_grouped_with_their_nearest() -> None:
    """Cameras that look away from each other are predicted all the same, never alone."""
    cameras = along(np.zeros(7))
    for index, camera in enumerate(cameras):
        angle = index * 2 * np.pi / 7
        camera.extrinsics[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        camera.extrinsics[:3, 3] = [-9 * np.sin(angle), 0, -9 * np.cos(angle)]
    groups = group_views(cameras, np.full(7, 0.1), 3)
    assert sorted(view for group in groups for view in group.used) == list(range(7))
    assert all(len(group.views) >= 2 for group in groups)
