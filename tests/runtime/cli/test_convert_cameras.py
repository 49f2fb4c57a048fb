"""The command `idesplat cameras`: what it reads it writes, or it says in one line why not."""

import json
from pathlib import Path

import numpy as np
import pytest
from camera_cases import CENTRED, as_llff, as_re10k, assert_same, colmap_model, known, save_images
from conftest import run_command
from idesplat.runtime.cameras.io import CameraFormat, detect_format, read_cameras
from idesplat.runtime.cli.cameras import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_colmap_to_both_jsons(folder, capsys):
    cameras = known(["0.jpg", "1.jpg"])
    colmap_model(cameras).write_binary(folder)
    for name, form in (("cameras.json", CameraFormat.OWN), ("out/transforms.json", CameraFormat.TRANSFORMS)):
        Path("out").mkdir(exist_ok=True)
        assert run_command(main, "convert", ".", name) == 0
        assert detect_format(Path(name)) is form
        assert_same(read_cameras(Path(name)), cameras)
    printed = capsys.readouterr().out
    assert "read 2 cameras as colmap: 2 of 640 x 480, focal length 510.2, no distortion" in printed
    assert "wrote cameras.json" in printed


def test_depth_ranges_go_along(folder):
    np.save("poses_bounds.npy", as_llff(known(["0", "1"], CENTRED), (2.0, 10.0)))
    assert run_command(main, "convert", "poses_bounds.npy", "cameras.json") == 0
    assert json.loads(Path("cameras.json").read_text())["cameras"][1]["depth_range"] == [1.5, 15.0]


def test_depth_ranges_that_a_file_does_not_hold_are_noted(folder, capsys):
    np.save("poses_bounds.npy", as_llff(known(["0", "1"], CENTRED), (2.0, 10.0)))
    assert run_command(main, "convert", "poses_bounds.npy", "transforms.json") == 0
    assert "does not hold depth ranges; those of 2 cameras were left out" in capsys.readouterr().out


def test_a_name_that_no_file_can_have_is_no_image(folder, capsys):
    frame = {"file_path": "a" * 300 + ".png", "transform_matrix": np.eye(4).tolist(), "fl_x": 9, "fl_y": 9}
    Path("transforms.json").write_text(json.dumps({"frames": [frame]}))
    assert run_command(main, "convert", "transforms.json", "cameras.json") == 2
    assert "transforms.json" in capsys.readouterr().err


def test_images_give_the_size(folder, capsys):
    cameras = known(["100", "200"])
    Path("trajectory.txt").write_text(as_re10k(cameras))
    assert run_command(main, "convert", "trajectory.txt", "cameras.json") == 2
    assert "give the images with --images" in capsys.readouterr().err and not Path("cameras.json").exists()
    save_images(folder / "frames", ["100.png"])
    assert run_command(main, "convert", "trajectory.txt", "cameras.json", "--images", "frames") == 0
    assert_same(read_cameras(Path("cameras.json")), cameras)
    first, second = save_images(folder / "frames", ["100.png", "200.png"])  # as a shell expands a pattern
    assert run_command(main, "convert", "trajectory.txt", "other.json", "--images", first, second) == 0
    assert_same(read_cameras(Path("other.json")), cameras)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("none.json", "out.json"), "none.json: cannot be read"),
        (("c.json", "out.txt"), "expected a file that ends in .json"),
        (("c.json", "./c.json"), "would replace the cameras"),
        (("c.json", "poses_bounds.npy/out.json"), "poses_bounds.npy is not a folder"),
        (("c.json", "out.json", "--camera-format", "re10k"), "c.json: line 1: has"),
    ],
)
def test_mistakes(folder, capfd, arguments, expected):
    Path("c.json").write_text('{"format": "idesplat-cameras", "version": 1, "cameras": []}\n')
    if "poses_bounds" in arguments[1]:
        Path("c.json").unlink()
        np.save("poses_bounds.npy", as_llff(known(["0", "1"], CENTRED)))
        arguments = ("poses_bounds.npy", *arguments[1:])
    before = sorted(Path().iterdir())
    assert run_command(main, "convert", *arguments) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("error: ") and expected in line
    assert sorted(Path().iterdir()) == before
