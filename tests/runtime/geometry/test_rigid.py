"""Rigid transforms beside trimesh's."""

import numpy as np
import trimesh
from idesplat.runtime.geometry.rigid import invert_rigid, transform_points

POSE = trimesh.transformations.compose_matrix(angles=(0.4, -1.1, 2.0), translate=(1.0, -2.0, 0.5))
POINTS = np.random.default_rng(0).normal(0, 3, (5, 4, 3))


def test_points_move_as_trimesh_moves_them_and_back() -> None:
    moved = transform_points(POSE, POINTS)
    flat = trimesh.transform_points(POINTS.reshape(-1, 3), POSE)
    np.testing.assert_allclose(moved.reshape(-1, 3), flat, atol=1e-12)
    np.testing.assert_allclose(transform_points(invert_rigid(POSE), moved), POINTS, atol=1e-12)
