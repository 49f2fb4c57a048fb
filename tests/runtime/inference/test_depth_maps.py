"""Saved depth leads back to points: through the archives alone, and through COLMAP."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import write_cameras
from idesplat.runtime.cli.infer import main
from idesplat.runtime.images.resizing import cover_crop
from idesplat.runtime.inference.colmap_workspace import normals_of, workspace_files, write_workspace
from idesplat.runtime.inference.depth_maps import write_depth_maps
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.views.batch import ViewBatch, build_view_batch
from tiny_model import write_model

HEIGHT, WIDTH = 64, 96
FULL_WIDTH, FULL_HEIGHT = 120, 100  # of the images; 96 x 80 of them are used, less 8 rows at each end
CROP = np.array([[0.8, 0, 0], [0, 0.8, -8], [0, 0, 1]])
NORMAL = np.array([0.3, -0.2, -1.0])  # of the plane in which all lies, at this distance from the origin
DISTANCE = -4.0


def plane_depth(camera: Camera) -> np.ndarray:
    """The plane's z-depth at a camera's pixel centres, [height, width]."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.extrinsics[:3, :3].T
    return (DISTANCE - camera.extrinsics[:3, 3] @ NORMAL) / (rays @ NORMAL)


def colours_of(points: np.ndarray) -> np.ndarray:
    """What colour the plane has at points [..., 3], so that every one can be recognised."""
    return 0.5 + 0.4 * np.sin(points * np.array([1.0, 1.5, 2.0]))


def original_cameras(count: int) -> list[Camera]:
    cameras = []
    for index in range(count):
        angle = 0.05 * (index - count / 2)
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = -0.2 * (index - count / 2), 0.05 * index, 0.1 * (index % 2)
        K = np.array([[110.0, 0, 61 + index], [0, 112.0, 49], [0, 0, 1]])
        cameras.append(Camera(f"images/view {index}.jpg", FULL_WIDTH, FULL_HEIGHT, K, pose))
    return cameras


def plane(count: int = 6) -> tuple[ViewBatch, Prediction]:
    """Views of the plane, and its true depth as if it had been predicted."""
    originals = original_cameras(count)
    cameras = [
        replace(camera, width=WIDTH, height=HEIGHT, K=CROP @ camera.K, depth_range=(1.0, 20.0)) for camera in originals
    ]
    depth = np.stack([plane_depth(camera) for camera in cameras])
    images = []
    for camera, values in zip(cameras, depth, strict=True):
        images.append(colours_of(back_projected(values, camera.K, camera.extrinsics)).transpose(2, 0, 1))
    intrinsics = np.stack([np.diag([1 / WIDTH, 1 / HEIGHT, 1]) @ camera.K for camera in cameras])
    names = [Path(camera.name).name for camera in originals]
    extrinsics = np.stack([camera.extrinsics for camera in cameras])
    views = ViewBatch(names, np.stack(images).astype(np.float32), extrinsics, intrinsics.astype(np.float32), originals)
    return views, Prediction(depth.astype(np.float32), None, {}, cameras)


def back_projected(depth: np.ndarray, K: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    """World points [height, width, 3] by the formula that `depth_maps` states."""
    x, y = np.meshgrid(np.arange(depth.shape[1]) + 0.5, np.arange(depth.shape[0]) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T
    return (depth[..., None] * rays) @ extrinsics[:3, :3].T + extrinsics[:3, 3]


def test_an_archive_leads_from_one_view_to_another(tmp_path: Path) -> None:
    """Pixels of one view at their depth, projected into another, have the depth that is saved there."""
    views, prediction = plane()
    write_depth_maps(tmp_path, ["a", "b", "c", "d", "e", "f"], prediction, views)
    with np.load(tmp_path / "a.npz") as first, np.load(tmp_path / "b.npz") as second:
        points = back_projected(first["depth"], first["K"], first["extrinsics"]).reshape(-1, 3)
        pose = np.linalg.inv(second["extrinsics"])
        pixels = (points @ pose[:3, :3].T + pose[:3, 3]) @ second["K"].T
        x, y = (pixels[:, :2] / pixels[:, 2:]).T - 0.5
        inside = (x >= 0) & (x <= WIDTH - 1) & (y >= 0) & (y <= HEIGHT - 1)
        assert inside.mean() > 0.5
        there = cv2.remap(second["depth"], x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).ravel()
        np.testing.assert_allclose(there[inside], pixels[inside, 2], rtol=1e-3)


def test_an_archive_says_where_in_the_image_it_lies(tmp_path: Path) -> None:
    views, prediction = plane(2)
    write_depth_maps(tmp_path, ["a", "b"], prediction, replace(views, offset=np.array([1e5, 0, 0])))
    for name, original in zip("ab", views.cameras, strict=True):
        with np.load(tmp_path / f"{name}.npz") as file:
            np.testing.assert_allclose(file["crop"], CROP)
            np.testing.assert_allclose(file["crop"] @ original.K, file["K"])
            assert str(file["image"]) == original.name
            assert file["image_size"].tolist() == [FULL_WIDTH, FULL_HEIGHT]
            assert (float(file["near"]), float(file["far"])) == (1, 20)
            assert file["offset"].tolist() == [1e5, 0, 0]
            assert file["depth"].dtype == np.float32
    assert cover_crop(FULL_WIDTH, FULL_HEIGHT, WIDTH, HEIGHT).matrix.tolist() == CROP.tolist()


def test_normals_are_the_planes() -> None:
    _, prediction = plane(2)
    camera = prediction.cameras[0]
    found = normals_of(prediction.depth[0], camera.K).transpose(1, 2, 0)
    expected = NORMAL / np.linalg.norm(NORMAL) @ camera.extrinsics[:3, :3]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-3)


def test_colmap_fuses_the_workspace(tmp_path: Path) -> None:
    """COLMAP's own fusion, with its own thresholds, finds the plane again: points, normals and colours."""
    pycolmap = pytest.importorskip("pycolmap")
    views, prediction = plane()
    stems = [Path(name).stem for name in views.names]
    written = write_workspace(tmp_path, stems, prediction, views)
    assert all(path.is_file() for path in written)
    assert set(written) <= set(workspace_files(tmp_path, stems))
    pycolmap.stereo_fusion(tmp_path / "fused.ply", tmp_path, output_type="PLY")
    fused = trimesh.load(tmp_path / "fused.ply")
    points, colours = np.asarray(fused.vertices), np.asarray(fused.colors)[:, :3]
    assert len(points) > 0.1 * HEIGHT * WIDTH  # one of the pixels that six views show of the same place
    # COLMAP puts a point at the medians of its pixels' coordinates, which lie beside each other on the slanting plane.
    pixel = float(np.median(prediction.depth)) / prediction.cameras[0].K[0, 0]
    assert np.abs((points @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)).max() < 0.5 * pixel
    assert np.abs(colours / 255 - colours_of(points)).max() < 0.06
    extent = np.ptp(points, axis=0)[:2] / np.ptp(unproject_all(prediction), axis=0)[:2]
    assert extent.min() > 0.9


def unproject_all(prediction: Prediction) -> np.ndarray:
    """The points of all pixels, [points, 3]."""
    pairs = zip(prediction.depth, prediction.cameras, strict=True)
    return np.concatenate([back_projected(depth, c.K, c.extrinsics).reshape(-1, 3) for depth, c in pairs])


def test_colmap_reads_the_sparse_model(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    views, prediction = plane(3)
    write_workspace(tmp_path, ["a", "b b", "c"], prediction, replace(views, offset=np.array([4e5, 5e6, 0.25])))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    images = [model.images[number] for number in sorted(model.images)]
    assert [image.name for image in images] == ["a.png", "b b.png", "c.png"]
    for image, camera in zip(images, prediction.cameras, strict=True):
        np.testing.assert_allclose(image.camera.calibration_matrix(), camera.K)
        np.testing.assert_allclose(image.cam_from_world().matrix(), np.linalg.inv(camera.extrinsics)[:3], atol=1e-12)
    assert len(model.points3D) > 500
    for point in model.points3D.values():
        assert len(point.track.elements) >= 2
        assert abs(point.xyz @ NORMAL - DISTANCE) < 1e-3
    assert model.compute_mean_reprojection_error() < 1e-3
    assert (tmp_path / "offset.txt").read_text() == "400000.0 5000000.0 0.25\n"


# ---- through the command


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Images of the plane, their cameras and a model, and we stand there."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    cameras = original_cameras(3)
    for camera in cameras:
        colours = colours_of(back_projected(plane_depth(camera), camera.K, camera.extrinsics))
        cv2.imwrite(camera.name, np.rint(255 * colours[..., ::-1]).astype(np.uint8))
    write_cameras(Path("cameras.json"), cameras)
    write_model(Path("model.onnx"), size_multiple=32)
    return tmp_path


COMMAND = ("--images", "images", "--cameras", "cameras.json", "--model", "model.onnx", "--out", "scene.ply")


def test_the_command_saves_what_leads_back(workplace: Path) -> None:
    assert run_command(main, *COMMAND, "--views", "3", "--save-depth", "depth", "--near", "1", "--far", "9") == 0
    cameras = original_cameras(3)
    views = build_view_batch([(Path(camera.name), camera) for camera in cameras], None, HEIGHT, WIDTH)
    for index, camera in enumerate(cameras):
        with np.load(f"depth/view {index}.npz") as file:
            np.testing.assert_allclose(file["K"], np.diag([WIDTH, HEIGHT, 1]) @ views.intrinsics[index], rtol=1e-6)
            np.testing.assert_array_equal(file["extrinsics"], camera.extrinsics)
            assert str(file["image"]) == camera.name


def test_the_command_writes_a_workspace(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    extras = ("--save-depth", "dense", "--depth-format", "colmap", "--json", "summary.json")
    assert run_command(main, *COMMAND, "--views", "3", *extras) == 0
    assert "colmap stereo_fusion --workspace_path dense" in capsys.readouterr().out
    assert "dense/stereo/fusion.cfg" in json.loads(Path("summary.json").read_text())["files"]
    depth = pycolmap.DepthMap()
    depth.read("dense/stereo/depth_maps/view 0.png.geometric.bin")
    assert depth.to_array().shape == (HEIGHT, WIDTH)


def test_a_form_of_depth_without_depth_is_refused(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(main, *COMMAND, "--depth-format", "colmap") == 2
    assert "--depth-format colmap: give --save-depth" in capsys.readouterr().err
    assert not Path("scene.ply").exists()
