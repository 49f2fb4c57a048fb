"""A model that was exported for a number of views gets that number, or nothing happens."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import write_cameras
from idesplat.runtime.cli.infer import main
from idesplat.tools.evaluation.cli import main as evaluate
from tiny_model import NETWORK, write_model

FOR_THREE = NETWORK.replace("[views", "[3")
USUAL = ("--cameras", "cameras.json", "--model", "model.onnx", "--near", "1", "--far", "9")
INFER = (*USUAL, "--out", "scene.ply")


@pytest.fixture(autouse=True)
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder with five images, their cameras and a model for three views."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    rng = np.random.default_rng(0)
    cameras = []
    for index in range(5):
        cv2.imwrite(f"images/{index:03}.png", rng.integers(0, 256, (64, 96, 3), np.uint8))
        pose = np.eye(4)
        pose[0, 3] = 0.3 * index
        K = np.array([[100.0, 0, 48], [0, 100, 32], [0, 0, 1]])
        cameras.append(Camera(f"images/{index:03}.png", 96, 64, K, pose))
    write_cameras(Path("cameras.json"), cameras)
    write_model(Path("model.onnx"), FOR_THREE, fixed_views=3, size_multiple=32)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    (
        (("--views", "4"), "--views 4: model.onnx was exported for 3 views; use --views 3"),
        (("--views", "2"), "--views 2: model.onnx was exported for 3 views; use --views 3"),
        (
            ("--select", "0,1,2,3"),
            "--select names 4 images: model.onnx was exported for 3 views; name 3, or add --views",
        ),
        (("--select", "0,1"), "--select names 2 images: model.onnx was exported for 3 views; name 3"),
        (("--select", "0,1", "--views", "3"), "--select names 2 images: model.onnx was exported for 3 views; name 3"),
    ),
)
def test_another_number_is_refused(
    arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(main, "--images", "images", *INFER, *arguments) == 2
    assert expected in capsys.readouterr().err
    assert not Path("scene.ply").exists()


def test_too_few_images_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(main, "--images", "images/000.png", "images/001.png", *INFER) == 2
    assert "model.onnx was exported for 3 views and got 2; give 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", ((), ("--views", "3"), ("--select", "0,2,4"), ("--select", "0,1,2,4", "--views", "3"))
)
def test_its_own_number_is_used(arguments: tuple[str, ...]) -> None:
    assert run_command(main, "--images", "images", *INFER, *arguments, "--json", "summary.json") == 0
    assert len(json.loads(Path("summary.json").read_text())["views"]) == 3


@pytest.mark.parametrize(
    ("arguments", "expected"),
    (
        (("--views", "4"), "--views 4: model.onnx was exported for 3 views; use --views 3"),
        (("--views", "2"), "--views 2: model.onnx was exported for 3 views; use --views 3"),
        (
            ("--context", "000", "--context", "001", "--hold-out", "002"),
            "model.onnx was exported for 3 views and got 2; give 3",
        ),
        (("--context", "000", "--context", "001", "--views", "2", "--hold-out", "002"), "--views and --context"),
    ),
)
def test_evaluation_keeps_to_it(arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(evaluate, "scene", "images", *USUAL, "--out", "out", *arguments) == 2
    assert expected in capsys.readouterr().err


def test_evaluation_uses_it() -> None:
    assert run_command(evaluate, "scene", "images", *USUAL, "--out", "out", "--hold-out", "002") == 0
    (scene,) = json.loads(Path("out/results.json").read_text())["scenes"]
    assert len(scene["context"]) == 3
