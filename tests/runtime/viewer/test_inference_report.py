"""The report of idesplat infer --report: its content, and that a browser shows it whatever files are called."""

import html
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cli.infer import main
from idesplat.runtime.splats.gaussians import Gaussians, with_colours
from idesplat.runtime.splats.points import points_from_depth
from idesplat.runtime.viewer.report import write_report
from idesplat.runtime.views.batch import ViewBatch

TRAP = "<img src=x onerror=document.title='caught'>"
SIDE = 64


@pytest.fixture(scope="module")
def written(scene, exported, tmp_path_factory) -> Path:
    """A folder with report.html and summary.json, from images whose names hold markup."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "images").mkdir()
    cameras = json.loads((scene / "transforms.json").read_text())
    for index, frame in enumerate(cameras["frames"][:3]):
        source = scene / frame["file_path"]
        frame["file_path"] = f"images/{index}{TRAP}.png"
        shutil.copy(source, folder / frame["file_path"])
    cameras["frames"] = cameras["frames"][:3]
    (folder / "transforms.json").write_text(json.dumps(cameras))
    options = ("--views", 3, "--report", folder / "report.html", "--json", folder / "summary.json")
    files = ("--images", folder / "images", "--cameras", folder / "transforms.json", "--model", exported[0])
    assert run_command(main, *files, "--out", folder / f"{TRAP}.ply", *options) == 0
    return folder


def test_shows_every_view_and_runs_nothing(browser, written):
    context = browser.new_context(offline=True)
    page = context.new_page()
    complaints, requests = [], []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: complaints.append(said.text))
    page.on("request", lambda request: requests.append(request.url))
    page.goto((written / "report.html").as_uri())
    widths = page.evaluate("Array.from(document.images, image => image.complete ? image.naturalWidth : 0)")
    titles = page.eval_on_selector_all("h3", "found => found.map(title => title.textContent)")
    title = page.title()
    context.close()
    assert widths == [96] * 3 * 4  # image, rendered, depth, consistency
    assert titles == [f"{index}{TRAP}.png" for index in range(3)]
    assert title == f"idesplat: {TRAP}.ply"
    assert complaints == []
    assert [url for url in requests if not url.startswith(("file:", "data:"))] == []


def test_shows_the_values_of_the_summary(written):
    page = html.unescape((written / "report.html").read_text())
    summary = json.loads((written / "summary.json").read_text())
    assert str(written / "report.html") in summary["files"]
    assert "3 images became 18,432 Gaussians" in page
    for name in ("load", "model", "total"):
        assert f"<th>{name}</th><td>{summary['seconds'][name]:.2f}</td>" in page
    for words in (f"{summary['near']:.6g}", summary["near_far_from"], "idesplat-small", *summary["notes"]):
        assert words in page


def flat_scene(colour: float) -> tuple[np.ndarray, Gaussians, ViewBatch]:
    """Two cameras in front of a grey wall, and splats of it with this brightness."""
    extrinsics = np.stack([np.eye(4), np.eye(4)])
    extrinsics[1, 0, 3] = 0.1
    intrinsics = np.tile(np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], np.float32), (2, 1, 1))
    images = np.full((2, 3, SIDE, SIDE), 0.5, np.float32)
    depth = np.full((2, SIDE, SIDE), 2.0, np.float32)
    means = points_from_depth(depth, images, extrinsics, intrinsics).positions
    count = len(means)
    scales, quats = np.full((count, 3), 0.05), np.tile([1.0, 0, 0, 0], (count, 1))
    wide = means * [3, 3, 1]  # beyond the edges of both images
    gaussians = with_colours(wide, scales * 3, quats, np.ones(count), np.full((count, 3), colour))
    return depth, gaussians, ViewBatch(["a", "b"], images, extrinsics, intrinsics, [])


def test_psnr_and_consistency_of_a_known_scene(tmp_path):
    depth, gaussians, views = flat_scene(0.6)
    depth[1, :, : SIDE // 2] = 4.0  # where it sees through what the first view sees
    write_report(tmp_path / "r.html", depth, gaussians, views, {"seconds": {}, "notes": [], "files": ["s.ply"]})
    page = (tmp_path / "r.html").read_text()
    found = [float(value) for value in re.findall(r"<figcaption>[^<]*PSNR ([\d.]+) dB", page)]
    assert found == pytest.approx([-20 * np.log10((153 - 128) / 255)] * 2, abs=0.05)
    assert "depth 2 to 4" in page
    confirmed = [int(value) for value in re.findall(r"<figcaption>consistency, mean (\d+) %", page)]
    # a point at depth 2 moves by 0.05 of the width: 45 % of the first view falls on the half that sees through it
    assert confirmed[0] == pytest.approx(55, abs=3)
