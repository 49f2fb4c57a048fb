"""Point clouds: positions against the cameras' own projection, and the files against another reader."""

import numpy as np
import plyfile
import pytest
import trimesh
from idesplat.export.stages import example_inputs
from idesplat.runtime.errors import InputError
from idesplat.runtime.point_cloud import POINT_SUFFIXES, points_from_depth, write_point_cloud


@pytest.fixture
def views():
    """Two turned cameras, 6x9 pixels: depth, images, extrinsics, intrinsics."""
    inputs = {name: value.numpy() for name, value in example_inputs(2, 6, 9, 0.5, 100.0).items()}
    depth = np.random.default_rng(0).uniform(1, 5, (2, 6, 9)).astype(np.float32)
    return depth, inputs["images"], inputs["extrinsics"], inputs["intrinsics"]


def test_points_project_back_to_their_pixels(views):
    depth, images, extrinsics, intrinsics = views
    cloud = points_from_depth(*views)
    assert cloud.positions.dtype == np.float32 and cloud.colours.dtype == np.uint8
    positions = cloud.positions.reshape(2, 6, 9, 3)
    for view in range(2):
        camera = np.linalg.inv(extrinsics[view])
        points = positions[view] @ camera[:3, :3].T + camera[:3, 3]
        np.testing.assert_allclose(points[..., 2], depth[view], rtol=1e-5)
        x, y, _ = np.moveaxis(points / points[..., 2:] @ intrinsics[view].T, -1, 0)
        rows, columns = np.mgrid[:6, :9]
        np.testing.assert_allclose(x * 9, columns + 0.5, atol=1e-4)
        np.testing.assert_allclose(y * 6, rows + 0.5, atol=1e-4)
    np.testing.assert_allclose(cloud.colours[9 + 2] / 255, images[0, :, 1, 2], atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("suffix", POINT_SUFFIXES)
def test_files_hold_the_points(views, suffix, tmp_path):
    cloud = points_from_depth(*views)
    path = tmp_path / f"scene{suffix}"
    write_point_cloud(path, cloud)
    read = trimesh.load(path, force="scene").to_geometry()
    np.testing.assert_allclose(read.vertices, cloud.positions, rtol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], cloud.colours)


def test_ply_is_what_every_viewer_reads(views, tmp_path):
    cloud = points_from_depth(*views)
    write_point_cloud(tmp_path / "scene.ply", cloud)
    vertex = plyfile.PlyData.read(tmp_path / "scene.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), cloud.positions)
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1), cloud.colours)


def test_a_folder_that_is_not_there_is_one_line(views, tmp_path):
    with pytest.raises(InputError, match="cannot write"):
        write_point_cloud(tmp_path / "nowhere" / "scene.ply", points_from_depth(*views))
