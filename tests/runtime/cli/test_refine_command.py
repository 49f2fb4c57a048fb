"""The command idesplat refine: it writes a scene closer to the images, and says in one line what is missing."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras, write_cameras
from idesplat.runtime.cli.refine import main
from idesplat.runtime.splats.formats.ply import write_ply
from idesplat.runtime.splats.gaussians import Gaussians, with_colours
from idesplat.runtime.splats.io import read_splats
from scene_files import snapshot


def grey_wall(camera: Camera) -> Gaussians:
    """A grid of Gaussians that fills what a camera sees, two units before it."""
    x, y = np.meshgrid(*(np.linspace(0, size, 16) for size in (camera.width, camera.height)))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.K).T
    means = 2 * rays @ camera.extrinsics[:3, :3].T + camera.extrinsics[:3, 3]
    count = len(means)
    quats, grey = np.tile((1.0, 0, 0, 0), (count, 1)), np.full((count, 3), 0.5)
    return with_colours(means, np.full((count, 3), 0.1), quats, np.full(count, 0.9), grey)


@pytest.fixture
def folder(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(scene / "images", tmp_path / "images")
    shutil.copy(scene / "transforms.json", tmp_path)
    write_ply(tmp_path / "scene.ply", grey_wall(read_cameras(tmp_path / "transforms.json")[0]))
    monkeypatch.chdir(tmp_path)
    return tmp_path


GIVEN = ("scene.ply", "-i", "images", "-c", "transforms.json")


def test_writes_a_refined_scene(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(main, *GIVEN, "-o", "out.ply", "--steps", "100", "--max-side", "64") == 0
    before, after = read_splats(Path("scene.ply")), read_splats(Path("out.ply"))
    assert len(before) == len(after) and not np.array_equal(before.sh, after.sh)
    first, last = map(float, re.findall(r"([0-9.]+) dB", capsys.readouterr().out))
    assert last > first + 1


def test_writes_refined_poses(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steps = ("--steps", "8", "--max-side", "64")
    assert run_command(main, *GIVEN, "-o", "out.ply", *steps, "--refine-poses", "poses.json") == 0
    assert "wrote poses.json" in capsys.readouterr().out
    before, after = read_cameras(Path("transforms.json")), read_cameras(Path("poses.json"))
    for given, refined in zip(before, after, strict=True):
        assert refined.name == given.name
        np.testing.assert_array_equal(refined.K, given.K)
        assert 0 < np.abs(refined.extrinsics - given.extrinsics).max() < 0.1


def test_images_without_a_camera_are_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As `idesplat infer` leaves out images that it cannot register, and writes the cameras of the others."""
    shutil.copy("images/000.png", "images/unregistered.png")
    assert run_command(main, *GIVEN, "-o", "out.ply", "--steps", "2", "--max-side", "64") == 0
    printed = capsys.readouterr().out
    assert "1 of 6 images have no camera; left out" in printed and "2 steps on 5 images" in printed


def test_cameras_that_do_not_show_the_scene_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    away = read_splats(Path("scene.ply"))
    write_ply(Path("scene.ply"), replace(away, means=away.means + np.float32(1000)))
    assert run_command(main, *GIVEN, "-o", "out.ply", "--steps", "6", "--max-side", "64") == 2
    assert "transforms.json: none of" in capsys.readouterr().err
    assert not Path("out.ply").exists()


def test_poses_that_their_file_cannot_hold_are_refused_first(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = [
        replace(camera, distortion=(0.1, 0, 0, 0, 0, 0.01, 0, 0)) for camera in read_cameras(Path("transforms.json"))
    ]
    write_cameras(Path("cameras.json"), cameras)
    Path("transforms.json").unlink()
    given = ("scene.ply", "-i", "images", "-c", "cameras.json", "-o", "out.ply", "--steps", "6", "--max-side", "64")
    assert run_command(main, *given, "--refine-poses", "transforms.json") == 2
    assert "a transforms.json can hold" in capsys.readouterr().err
    assert not Path("out.ply").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("scene.ply", "-i", "images", "-o", "out.ply"), "--cameras: missing"),
        (GIVEN, "--out: missing"),
        ((*GIVEN, "-o", "scene.ply"), "scene.ply"),
        ((*GIVEN, "-o", "out.txt"), "out.txt"),
        (("none.ply", *GIVEN[1:], "-o", "out.ply"), "none.ply"),
        ((*GIVEN, "-o", "out.ply", "--refine-poses", "transforms.json"), "transforms.json"),
    ],
)
def test_invalid_input_is_one_line(
    folder: Path, arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = snapshot(folder)
    assert run_command(main, *arguments) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
    assert snapshot(folder) == before
