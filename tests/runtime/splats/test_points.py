"""Points and surfaces: positions against the cameras' own projection, and the files against another reader."""

import numpy as np
import plyfile
import pytest
import trimesh
from idesplat.export.example_inputs import example_inputs
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import write_splats
from idesplat.runtime.splats.mesh import faces_from_depth
from idesplat.runtime.splats.points import (
    MESH_SUFFIXES,
    POINT_SUFFIXES,
    points_from_depth,
    points_from_gaussians,
    write_mesh,
    write_point_cloud,
)


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


def srgb(linear):
    """The other way than the writer goes."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def check_points(path, positions, colours, cloud):
    """The cloud's positions and colours; glTF has x left, y up, and linear colours in 8 bits."""
    if path.suffix == ".glb":
        np.testing.assert_allclose(positions, cloud.positions * [-1, -1, 1], rtol=1e-6)
        step = 12.92 / 255  # of a linear byte where sRGB is steepest
        np.testing.assert_allclose(srgb(colours / 255), cloud.colours / 255, atol=step / 2 + 1e-6)
    else:
        np.testing.assert_allclose(positions, cloud.positions, rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(colours, cloud.colours)


@pytest.mark.parametrize("suffix", POINT_SUFFIXES)
def test_files_hold_the_points(views, suffix, tmp_path):
    cloud = points_from_depth(*views)
    path = tmp_path / f"scene{suffix}"
    write_point_cloud(path, cloud)
    if suffix == ".xyz":  # whose colours trimesh reads only with an alpha
        table = np.loadtxt(path)
        check_points(path, table[:, :3], table[:, 3:], cloud)
        return
    read = trimesh.load(path, force="scene").to_geometry()
    check_points(path, read.vertices, read.colors[:, :3], cloud)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_files_hold_the_surface(views, suffix, tmp_path):
    depth, *_ = views
    cloud, faces = points_from_depth(*views), faces_from_depth(depth, 0.5)
    assert 0 < len(faces) < 2 * 2 * 5 * 8
    path = tmp_path / f"scene{suffix}"
    write_mesh(path, cloud, faces)
    read = trimesh.load(path, force="scene", process=False, maintain_order=True).to_geometry()
    np.testing.assert_array_equal(read.faces, faces)
    check_points(path, read.vertices, read.visual.vertex_colors[:, :3], cloud)


def test_a_surface_faces_the_camera_and_ends_where_depth_jumps(views):
    _, images, extrinsics, intrinsics = views
    depth = np.full((2, 6, 9), 2, np.float32)
    depth[0, :, 4:] = 2.2
    depth[1, 2:4, 2:4] = 2.06
    cut, whole = faces_from_depth(depth), faces_from_depth(depth, 0.11)
    assert len(whole) == 2 * 2 * 5 * 8
    assert len(cut) == len(whole) - 2 * 5  # a column of squares
    crossing = {tuple(sorted(face)) for face in whole} - {tuple(sorted(face)) for face in cut}
    assert all({3, 4} <= {index % 9 for index in face} for face in crossing)
    positions = points_from_depth(depth, images, extrinsics, intrinsics).positions.astype(np.float64)
    corners = positions[cut]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cameras = extrinsics[cut[:, 0] // 54, :3, 3]
    assert (np.einsum("ni,ni->n", normals, cameras - corners[:, 0]) > 0).all()


def test_points_of_gaussians(views):
    count = 4
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = (np.array([[0, 0.5, 1], [-1, 2, 0.25], [1, 1, 1], [0, 0, 0]]) - 0.5) / 0.28209479177387814
    sh[:, 1:] = 5
    means = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    ones = np.ones(count, np.float32)
    gaussians = Gaussians(means, np.tile(ones[:, None], 3), np.tile(ones[:, None], 4), ones, sh)
    cloud = points_from_gaussians(gaussians)
    np.testing.assert_array_equal(cloud.positions, means)
    np.testing.assert_array_equal(cloud.colours, [[0, 128, 255], [0, 255, 64], [255] * 3, [0] * 3])


def test_ply_is_what_every_viewer_reads(views, tmp_path):
    cloud = points_from_depth(*views)
    write_point_cloud(tmp_path / "scene.ply", cloud)
    vertex = plyfile.PlyData.read(tmp_path / "scene.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), cloud.positions)
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1), cloud.colours)


def test_a_folder_that_is_not_there_is_one_line(views, tmp_path):
    with pytest.raises(InputError, match="cannot write"):
        write_point_cloud(tmp_path / "nowhere" / "scene.ply", points_from_depth(*views))


def test_points_without_any_are_refused_by_glb(tmp_path):
    none = Gaussians(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (3,), (4,), (), (1, 3))))
    with pytest.raises(InputError, match=r"cannot write .*a\.points\.glb: there are no points"):
        write_splats(tmp_path / "a.points.glb", none)
    assert not list(tmp_path.iterdir())
