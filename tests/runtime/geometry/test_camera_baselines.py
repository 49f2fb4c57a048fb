"""Pairs of cameras by their baselines."""

from idesplat.runtime.geometry.baselines import connected_neighbor_pairs, nearest_neighbor_pairs
from views_in_a_row import extrinsics_in_a_row


def test_pairs_connect_distant_groups():
    groups = extrinsics_in_a_row(0, 1, 3, 10, 12, 13)
    assert nearest_neighbor_pairs(groups) == [(0, 1), (1, 2), (3, 4), (4, 5)]
    assert connected_neighbor_pairs(groups, 1) == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    assert connected_neighbor_pairs(groups, 2) == [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (3, 5), (4, 5)]


def test_more_neighbours_than_cameras_are_all():
    assert connected_neighbor_pairs(extrinsics_in_a_row(0, 1), 3) == [(0, 1)]
    assert connected_neighbor_pairs(extrinsics_in_a_row(0, 5, 6), 3) == [(0, 1), (0, 2), (1, 2)]
