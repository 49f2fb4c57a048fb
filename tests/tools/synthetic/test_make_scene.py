"""The command that writes a synthetic scene as a folder of images with cameras and depth."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import EXIT_STATUS
from idesplat.tools.synthetic.make_scene import make_scene

HEIGHT, WIDTH = 72, 96


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "new" / "scene"
    make_scene(folder, seed=2, views=3, height=HEIGHT, width=WIDTH)
    return folder


def test_writes_images_cameras_and_depth(scene: Path) -> None:
    names = [f"{index:03}" for index in range(3)]
    assert sorted(path.name for path in (scene / "images").iterdir()) == [f"{name}.png" for name in names]
    assert sorted(path.name for path in (scene / "depth").iterdir()) == [f"{name}.npz" for name in names]
    cameras = read_cameras(scene / "transforms.json")
    assert [camera.name for camera in cameras] == [f"images/{name}.png" for name in names]
    for camera in cameras:
        image = cv2.imread(str(scene / camera.name))
        assert image.shape == (HEIGHT, WIDTH, 3) == (camera.height, camera.width, 3)
        assert camera.distortion is None
        assert image.std() > 15
    assert not list(scene.rglob(".*"))  # no temporary file stays


def test_depth_warps_one_image_onto_another(scene: Path) -> None:
    """With cameras read from transforms.json, so that conventions of axes, intrinsics and depth are tested."""
    first, *_, last = read_cameras(scene / "transforms.json")
    depth, depth_there = (
        np.load(scene / "depth" / f"{Path(camera.name).stem}.npz")["depth"] for camera in (first, last)
    )
    assert depth.shape == (HEIGHT, WIDTH) and depth.dtype == np.float32
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(first.K).T * depth[..., None]
    relative = np.linalg.inv(last.extrinsics) @ first.extrinsics
    points = points @ relative[:3, :3].T + relative[:3, 3]
    pixels = (points @ last.K.T)[..., :2] / points[..., 2:] - 0.5
    there = cv2.remap(depth_there, pixels.astype(np.float32), None, cv2.INTER_NEAREST)
    visible = np.abs(there / points[..., 2] - 1) < 0.02
    assert visible.mean() > 0.4
    images = [cv2.imread(str(scene / camera.name)).astype(np.float32) for camera in (first, last)]
    unwarped = np.abs(images[1] - images[0])[visible].mean()
    warped = cv2.remap(images[1], pixels.astype(np.float32), None, cv2.INTER_LINEAR)
    assert np.abs(warped - images[0])[visible].mean() < 0.35 * unwarped


def test_files_depend_on_the_seed_alone(scene: Path, tmp_path: Path) -> None:
    make_scene(tmp_path / "again", seed=2, views=3, height=HEIGHT, width=WIDTH)
    make_scene(tmp_path / "other", seed=3, views=2, height=HEIGHT, width=WIDTH)
    for name in ("images/001.png", "transforms.json"):
        assert (tmp_path / "again" / name).read_bytes() == (scene / name).read_bytes()
        assert (tmp_path / "other" / name).read_bytes() != (scene / name).read_bytes()


@pytest.mark.slow
def test_command_prints_outputs_and_one_line_errors(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "idesplat.tools.synthetic.make_scene"]
    small = ["--views", "2", "--height", "32", "--width", "48"]
    done = subprocess.run([*command, str(tmp_path / "scene"), *small], capture_output=True, text=True, check=True)
    assert str(tmp_path / "scene" / "transforms.json") in done.stdout
    assert (tmp_path / "scene" / "images" / "001.png").is_file()
    (tmp_path / "file").write_text("")
    failed = subprocess.run([*command, str(tmp_path / "file"), *small], capture_output=True, text=True)
    assert failed.returncode == EXIT_STATUS
    assert failed.stderr.startswith("error: ") and failed.stderr.count("\n") == 1
    assert str(tmp_path / "file") in failed.stderr
