"""Scenes far from the origin: what float32 loses is said, and an offset keeps it and is recorded."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras, write_cameras
from idesplat.runtime.cli.convert import main as convert_main
from idesplat.runtime.cli.infer import main
from idesplat.runtime.cli.render import main as render_main
from idesplat.runtime.cli.view import _relative
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.gaussians import with_colours
from idesplat.runtime.splats.io import FORMATS, read_offset, read_splats, write_splats
from idesplat.runtime.viewer.viser_scene import Viewpoint
from idesplat.runtime.views.world_offset import parse_offset
from tiny_model import write_model

PLACE = np.array([433125.25, 5411987.5, 312.125])  # eastings, northings and height, in metres
OFFSET = "433125.25,5411987.5,312.125"
# The formats with room for an offset, and those without.
RECORDING = (".ply", ".compressed.ply", ".sog", ".glb")
OTHERS = (".splat", ".spz")


def cameras_at(place: np.ndarray) -> list[Camera]:
    cameras = []
    for index in range(2):
        pose = np.eye(4)
        pose[:3, 3] = place
        pose[0, 3] += 0.3 * index
        K = np.array([[100.0, 0, 48], [0, 100, 32], [0, 0, 1]])
        cameras.append(Camera(f"images/{index}.png", 96, 64, K, pose))
    return cameras


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Images, their cameras at the origin and far away from it, and a model, and we stand there."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    rng = np.random.default_rng(0)
    for index in range(2):
        cv2.imwrite(f"images/{index}.png", rng.integers(0, 256, (64, 96, 3), np.uint8))
    write_cameras(Path("near.json"), cameras_at(np.zeros(3)))
    write_cameras(Path("far.json"), cameras_at(PLACE))
    write_model(Path("model.onnx"), size_multiple=32)
    return tmp_path


def infer(cameras: str, out: str, *more: str) -> int:
    given = ("--images", "images", "--cameras", cameras, "--model", "model.onnx", "--out", out)
    return run_command(main, *given, "--near", "1", "--far", "20", *more)


def test_lost_precision_is_said(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert infer("far.json", "far.ply") == 0
    printed = capsys.readouterr().out
    # 2^-1 m is float32's step from 4,194,304 m on; a pixel at the near plane is 1 m / 100
    assert "warning: at coordinates of 5.412e+06, float32 places splats in steps of 0.5" in printed
    assert "--offset auto" in printed
    assert infer("near.json", "near.ply") == 0
    assert "warning" not in capsys.readouterr().out


@pytest.mark.parametrize(("place", "warns"), ((1e4, False), (1e5, True)))
def test_it_is_the_step_beside_the_size_of_splats_that_counts(
    workplace: Path, capsys: pytest.CaptureFixture[str], place: float, warns: bool
) -> None:
    """In steps of 1 mm nothing is lost of splats of 10 mm, in steps of 8 mm they are torn."""
    write_cameras(Path("far.json"), cameras_at(np.array([place, 0, 0])))
    assert infer("far.json", "far.ply") == 0
    assert ("warning" in capsys.readouterr().out) == warns


@pytest.mark.parametrize("given", ("auto", OFFSET))
def test_an_offset_keeps_the_scene_and_is_recorded(workplace: Path, given: str) -> None:
    """The scene is the same as at the origin, to float32's precision there, and so are depth, render and summary."""
    assert infer("near.json", "near.ply") == 0
    arguments = ("--offset", given, "--json", "far.json.out", "--save-depth", "depth", "--save-cameras", "saved.json")
    assert infer("far.json", "far.ply", *arguments, "--render", "views") == 0
    offset = read_offset(Path("far.ply"))
    assert np.abs(offset - PLACE).max() <= (0 if given == OFFSET else 1)
    expected, found = read_splats(Path("near.ply")), read_splats(Path("far.ply"))
    close = np.abs(found.means + (offset - PLACE) - expected.means).max(axis=1) < 1e-4
    assert close.mean() > 0.999
    assert json.loads(Path("far.json.out").read_text())["offset"] == offset.tolist()
    with np.load("depth/0.npz") as file:
        assert file["offset"].tolist() == offset.tolist()
        np.testing.assert_allclose(file["extrinsics"][:3, 3] + offset, PLACE, atol=1e-9)
    # the cameras stay the user's own, and lead to the same image as rendering during inference
    for camera, original in zip(read_cameras(Path("saved.json")), cameras_at(PLACE), strict=True):
        np.testing.assert_array_equal(camera.extrinsics, original.extrinsics)
    assert run_command(render_main, "far.ply", "--cameras", "saved.json", "--out", "renders") == 0
    at_once, later = (cv2.imread(path).astype(float) for path in ("views/view-0.png", "renders/0.png"))
    assert at_once.std() > 5
    assert np.abs(at_once - later).max() <= 1


def test_auto_leaves_coordinates_alone_that_float32_holds(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert infer("near.json", "near.ply", "--offset", "auto") == 0
    assert "no offset is needed" in capsys.readouterr().out
    assert not read_offset(Path("near.ply")).any()


def test_an_offset_elsewhere_does_not_help(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert infer("far.json", "far.ply", "--offset", "1,2,3") == 0
    assert "warning: at coordinates of 5.412e+06" in capsys.readouterr().out


@pytest.mark.parametrize("text", ("", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "inf,0,0", "1e10,0,0", "1;2;3"))
def test_what_is_no_offset_is_refused(workplace: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="expected auto, or X,Y,Z"):
        parse_offset(text)
    assert infer("far.json", "far.ply", "--offset", text) == 2
    assert not Path("far.ply").exists()


def some_gaussians():
    rng = np.random.default_rng(3)
    values = [rng.random((40, width)) for width in (3, 3, 4, 1, 3)]
    return with_colours(*values[:3], values[3][:, 0], values[4])


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats_record_offsets_or_say_that_they_do_not(tmp_path: Path, suffix: str) -> None:
    path, plain = tmp_path / f"scene{suffix}", tmp_path / f"plain{suffix}"
    notes = write_splats(path, some_gaussians(), PLACE)
    assert write_splats(plain, some_gaussians()) == [note for note in notes if "relative" not in note]
    assert not read_offset(plain).any()
    if suffix in RECORDING:
        np.testing.assert_array_equal(read_offset(path), PLACE)
    else:
        assert suffix in OTHERS
        assert "relative to 433125.25, 5411987.5, 312.125" in notes[-1]
    found, expected = read_splats(path), read_splats(plain)
    np.testing.assert_array_equal(found.means, expected.means)


def test_conversion_keeps_the_offset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.ply"
    write_splats(path, some_gaussians(), PLACE)
    for suffix in RECORDING[1:]:
        converted = path.with_name(f"converted{suffix}")
        assert run_command(convert_main, path, converted) == 0
        np.testing.assert_array_equal(read_offset(converted), PLACE)
    assert run_command(convert_main, path, tmp_path / "converted.splat") == 0
    assert "does not record that its coordinates are relative to 433125.25" in capsys.readouterr().out


@pytest.mark.parametrize("line", ("nan 0 0", "a b c", "1e999 0 0"))
def test_a_damaged_record_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "scene.ply"
    write_splats(path, some_gaussians(), PLACE)
    path.write_bytes(path.read_bytes().replace(b"433125.25 5411987.5 312.125", line.encode()))
    with pytest.raises(InputError, match="records the offset"):
        read_offset(path)


def test_the_viewer_puts_cameras_where_the_scene_is(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    write_splats(path, some_gaussians(), PLACE)
    (found,) = _relative([Viewpoint(cameras_at(PLACE)[0], None)], path)
    np.testing.assert_array_equal(found.camera.extrinsics, np.eye(4))
    camera = replace(cameras_at(PLACE)[0], extrinsics=np.eye(4))
    write_splats(path, some_gaussians())
    assert _relative([Viewpoint(camera, None)], path)[0].camera is camera
