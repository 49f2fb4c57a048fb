"""The evaluation of cameras that are estimated of few photographs, on a synthetic room."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.tools.evaluation.captures.estimated_cameras import MAX_ERROR, auc, main, pose_error
from idesplat.tools.synthetic.make_scene import make_scene
from one_capture import commit_all, list_one_capture

REPOSITORY, FOLDER = "someone/photos", "images"


def test_the_area_under_the_curve_is_that_of_its_definition() -> None:
    assert auc([0, 0], 5) == 1 and auc([5, MAX_ERROR], 5) == 0
    assert auc([1, 2.5, 180], 5) == pytest.approx((0.8 + 0.5 + 0) / 3)


def test_the_error_of_a_pose_is_the_larger_one_of_its_angles() -> None:
    first, second = np.eye(4), np.eye(4)
    second[:3, 3] = 1, 0, 0
    known = [Camera(name, 2, 2, np.eye(3), pose) for name, pose in (("a", first), ("b", second))]
    moved, turned = second.copy(), second.copy()
    moved[:3, 3] = 2 * np.cos(0.1), 2 * np.sin(0.1), 0  # the length does not count
    turned[:2, :2] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    turned[:3, 3] = np.cos(0.1), np.sin(0.1), 0
    for pose, expected in ((second, 0.0), (moved, np.degrees(0.1)), (turned, np.degrees(0.2))):
        found = replace(known[1], extrinsics=pose)
        assert pose_error(known[0], known[0], known[1], found) == pytest.approx(expected, abs=1e-5)
    assert pose_error(known[0], known[0], known[1], None) == MAX_ERROR


@pytest.mark.slow
def test_a_room_is_estimated_with_and_without_its_focal_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pycolmap")
    make_scene(tmp_path / "scene", seed=2, views=3, height=360, width=480)
    root = tmp_path / REPOSITORY
    shutil.copytree(tmp_path / "scene" / "images", root / FOLDER)
    names = sorted(path.name for path in (root / FOLDER).iterdir())
    fields = {
        **{"repository": REPOSITORY, "commit": commit_all(root), "folder": FOLDER, "epipolar_px": 0.1},
        **{"triples": [[names[0], names[2], names[1]]], "views": names[::2], "between": names[1:2]},
    }
    list_one_capture(tmp_path / "captures.json", tmp_path / "scene", fields, monkeypatch)
    capsys.readouterr()
    for options in ((), ("--focal-error", "0")):
        assert run_command(main, "--checkouts", tmp_path, *options) == 0
        row = next(line for line in capsys.readouterr().out.splitlines() if line.strip(" │|").startswith("3 "))
        images, windows, registered, whole, under, closely, widely, *_ = row.replace("│", " ").split()
        assert (images, windows, registered, whole, under) == ("3", "1", "100%", "100%", "0%")
        assert 0.3 < float(closely) < float(widely) < 1 and float(widely) > 0.85
