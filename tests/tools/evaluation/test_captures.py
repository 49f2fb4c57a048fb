"""Real captures: their file, checkouts of their repositories, and the command that evaluates a model on them."""

import hashlib
import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat import Predictor, read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.reconstruction.steps import make_plan
from idesplat.runtime.splats.filtering import FilterOptions, filter_gaussians
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.exposure import Exposure
from idesplat.runtime.views.exposure_mode import ExposureMode
from idesplat.tools.evaluation import evaluate as library
from idesplat.tools.evaluation.captures import capture as captures
from idesplat.tools.evaluation.captures import checkouts, choose, spoiled
from idesplat.tools.evaluation.captures.capture import CaptureImages, parse_view_counts, read_captures
from idesplat.tools.evaluation.captures.checkouts import extract, fetch_checkout, find_checkout, list_folder
from idesplat.tools.evaluation.captures.scores import CaptureEvaluator, Scene, input_psnr
from idesplat.tools.evaluation.cases import PosedImages
from idesplat.tools.evaluation.cli import main
from idesplat.tools.evaluation.metrics import HIGHEST_PSNR, fit_exposure, psnr
from idesplat.tools.evaluation.novel_views import render_target
from one_capture import commit_all, git, list_one_capture

FROZEN = "80acbf9275524955671281f8624c836b5390a7f5a0c16d9198441bf9f610e824"
TRAINED_ON = {"vork/maryRose", "alicevision/dataset_buddha"}
KINDS = {"room", "object", "facade", "vegetation", "aerial"}
REPOSITORY, FOLDER = "someone/photos", "some/images"
NAMES = [f"{index:03}.png" for index in range(5)]
Capsys = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def repository(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A work tree called OWNER/NAME with the scene's images, from which others can be cloned, and its commit."""
    root = tmp_path_factory.mktemp("host") / REPOSITORY
    shutil.copytree(scene / "images", root / FOLDER)
    (root / "readme").write_text("a file beside them")
    commit = commit_all(root)
    git(root, "config", "uploadpack.allowFilter", "true")
    git(root, "config", "uploadpack.allowAnySHA1InWant", "true")
    return root, commit


@pytest.fixture
def capture_file(scene: Path, repository: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with one capture, the scene: three views with two held-out frames between, and one triple."""
    fields = {
        **{"repository": REPOSITORY, "commit": repository[1], "folder": FOLDER, "epipolar_px": 0.1},
        **{"triples": [["000.png", "004.png", "002.png"]], "views": NAMES[::2], "between": NAMES[1::2]},
    }
    path = tmp_path / "captures.json"
    list_one_capture(path, scene, fields, monkeypatch)
    return path


def test_the_captures_are_frozen() -> None:
    """Results are compared across versions, so other frames or cameras need another list (docs/captures.md).

    Near and far of the frames are those of `depth_bounds`, as an import of the cameras finds them.
    """
    content = json.loads(captures.CAPTURES_FILE.read_text())
    for capture in content["captures"]:
        capture["frames"] = [frame[:4] for frame in capture["frames"]]
    assert hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest() == FROZEN


def test_the_captures_are_ten_of_many_kinds() -> None:
    found = read_captures()
    assert len(found) >= 10 and {capture.kind for capture in found} >= KINDS


def test_every_number_of_views_up_to_24_is_had_by_several_captures() -> None:
    lengths = [len(capture.views) for capture in read_captures()]
    assert min(lengths) >= 6
    assert sum(length >= 12 for length in lengths) >= 6 and sum(length >= 24 for length in lengths) >= 3


def test_the_captures_are_not_for_training() -> None:
    found = read_captures()
    assert not TRAINED_ON & {capture.repository for capture in found}
    assert len({capture.name for capture in found}) == len(found)
    for capture in found:
        assert len(capture.commit) == 40 and capture.licence
        assert len(capture.triples) == 3
        held_out = {triple.target for triple in capture.triples}
        assert len(held_out) == 3 and not set(capture.between) & set(capture.views)
        assert len(set(capture.views)) == len(capture.views)


def test_each_held_out_frame_of_the_captures_lies_between_two_views() -> None:
    for capture in read_captures():
        between = [capture.neighbours(target) for target in capture.between]
        for triple in [*capture.triples, *between]:
            first, second, target = (
                capture.cameras[name].extrinsics[:3, 3] for name in (*triple.context, triple.target)
            )
            way = second - first
            assert 0.2 < (target - first) @ way / (way @ way) < 0.8


def test_windows_of_more_views_contain_the_smaller_ones() -> None:
    for capture in read_captures():
        windows = [capture.window(count) for count in range(2, len(capture.views) + 1)]
        for (views, targets), (more_views, more_targets) in pairwise(windows):
            assert set(views) < set(more_views) and set(targets) < set(more_targets)
        assert capture.window(len(capture.views) + 1) == ([], [])


def test_cameras_survive_their_file(capture_file: Path, scene: Path) -> None:
    (capture,) = read_captures()
    for camera in read_cameras(scene / "transforms.json"):
        again = capture.cameras[Path(camera.name).name]
        np.testing.assert_allclose(again.extrinsics, camera.extrinsics, atol=1e-7)
        np.testing.assert_allclose(again.K, camera.K, atol=1e-4)


@pytest.mark.parametrize("name", ["someone+photos", "someone/photos"])
@pytest.mark.parametrize("bare", [False, True])
def test_checkouts_are_found_as_git_directory_or_work_tree(
    name: str, bare: bool, repository: tuple[Path, str], tmp_path: Path
) -> None:
    root, commit = repository
    git(tmp_path, "clone", "--quiet", *(["--bare"] if bare else []), str(root), name)
    checkout = find_checkout(tmp_path, REPOSITORY)
    assert checkout == tmp_path / name
    assert sorted(list_folder(checkout, commit, FOLDER)) == NAMES and list_folder(checkout, commit, "absent") == []
    extract(checkout, commit, FOLDER, NAMES[:2], tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == NAMES[:2]
    assert (tmp_path / "out" / "001.png").read_bytes() == (root / FOLDER / "001.png").read_bytes()


def test_a_file_changed_in_the_work_tree_has_no_effect(repository: tuple[Path, str], tmp_path: Path) -> None:
    root, commit = repository
    checkout = tmp_path / "someone+photos"
    git(tmp_path, "clone", "--quiet", str(root), str(checkout))
    (checkout / FOLDER / "000.png").write_bytes(b"changed")
    extract(checkout, commit, FOLDER, ["000.png"], tmp_path / "out")
    assert (tmp_path / "out" / "000.png").read_bytes() == (root / FOLDER / "000.png").read_bytes()


def test_missing_checkouts_are_cloned_once(repository: tuple[Path, str], tmp_path: Path) -> None:
    root, commit = repository
    host = f"file://{root.parents[1]}"
    folder = tmp_path / "new" / "checkouts"
    checkout = fetch_checkout(folder, REPOSITORY, commit, host)
    extract(checkout, commit, FOLDER, ["003.png"], tmp_path / "out")
    assert (tmp_path / "out" / "003.png").read_bytes() == (root / FOLDER / "003.png").read_bytes()
    assert fetch_checkout(folder, REPOSITORY, commit, "file:///nowhere") == checkout
    assert [path.name for path in folder.iterdir()] == ["someone+photos"]


def test_a_failed_clone_is_one_line_and_leaves_no_files(repository: tuple[Path, str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="git fetch failed") as error:
        fetch_checkout(tmp_path, REPOSITORY, repository[1], f"file://{tmp_path}/nowhere")
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())
    host = f"file://{repository[0].parents[1]}"
    with pytest.raises(InputError, match="git fetch failed"):
        fetch_checkout(tmp_path, REPOSITORY, "0" * 40, host)
    fetch_checkout(tmp_path, REPOSITORY, repository[1], host)
    with pytest.raises(InputError, match="expected the pinned commit"):
        fetch_checkout(tmp_path, REPOSITORY, "0" * 40, host)


def test_missing_git_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="git is needed"):
        fetch_checkout(tmp_path / "checkouts", REPOSITORY, "0" * 40)


def test_fitting_the_exposure_finds_gain_and_offset() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.3, 0.7, (20, 30, 3)).astype(np.float32)
    valid = np.ones((20, 30), bool)
    image = (truth - [0.1, 0.0, -0.05]) / [1.2, 0.8, 1.0]
    valid[3:5] = False
    image[3:5] = 0  # what is not valid takes no part
    assert psnr(image, truth, valid) < 25
    assert psnr(fit_exposure(image, truth, valid), truth, valid) == pytest.approx(HIGHEST_PSNR, abs=1)
    noisy = np.clip(image + rng.normal(0, 0.1, image.shape), 0, 1)
    fitted = fit_exposure(noisy, truth, valid)
    for channel in range(3):
        line = np.polyfit(noisy[valid][:, channel], truth[valid][:, channel], 1)
        np.testing.assert_allclose(fitted[valid][:, channel], np.polyval(line, noisy[valid][:, channel]), atol=1e-5)
    flat = np.full_like(truth, 0.25)  # one colour: no gain can be told
    np.testing.assert_allclose(fit_exposure(flat, truth, valid)[0, 0], truth[valid].mean(axis=0), atol=1e-5)


@pytest.fixture
def measured(
    capture_file: Path,
    repository: tuple[Path, str],
    exported: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capsys,
) -> tuple[dict[str, Any], Predictor]:
    """The command's results for triples and three views, with the predictor that it used."""
    opened = Predictor(exported[0])
    monkeypatch.setattr(library, "Predictor", lambda path, *where: opened)
    monkeypatch.chdir(capture_file.parent)
    checkouts_folder = repository[0].parents[1]
    options = ("--checkouts", checkouts_folder, "--model", exported[0], "--out", "out", "--views", "3, 2,4")
    assert run_command(main, "captures", *options) == 0
    return json.loads(Path("out/results.json").read_text()), opened


def test_the_command_gives_the_metrics_of_the_predictor_used_by_hand(
    measured: tuple[dict[str, Any], Predictor], scene: Path, capsys: Capsys
) -> None:
    content, opened = measured
    (capture,) = read_captures()
    images = CaptureImages(capture, scene / "images", (64, 96))
    case = images.case(["000.png", "002.png", "004.png"], ["001.png", "003.png"], opened.depth_range)
    context = case.context
    prediction = opened.predict_arrays(context.images, context.extrinsics, context.intrinsics, case.near, case.far)
    truth = case.targets.image(1)
    rendered = render_target(prediction.need_gaussians(), case.targets, 1).rgb
    expected = -10 * np.log10(np.mean((rendered.clip(0, 1) - truth) ** 2))

    (entry,) = content["captures"]
    assert content["command"] == "captures" and content["size"] == [64, 96] and content["views"] == [2, 3, 4]
    assert set(entry["cases"]) == {"2", "3"} == set(content["mean"])  # there are no four views
    (window,) = entry["cases"]["3"]
    scores = window["targets"][1]["scores"]
    assert [target["name"] for target in window["targets"]] == ["001.png", "003.png"]
    assert scores["model"]["psnr"] == pytest.approx(expected, abs=1e-3)
    assert scores["model"]["psnr_fitted"] >= scores["model"]["psnr"]
    gaussians = prediction.need_gaussians()
    inputs = [
        -10
        * np.log10(
            np.mean((render_target(gaussians, case.context, view).rgb.clip(0, 1) - case.context.image(view)) ** 2)
        )
        for view in range(3)
    ]
    assert window["input_psnr"] == pytest.approx(np.mean(inputs), abs=1e-3)

    pair = images.case(["002.png", "004.png"], ["003.png"], opened.depth_range)
    of_two = opened.predict_arrays(
        pair.context.images, pair.context.extrinsics, pair.context.intrinsics, pair.near, pair.far
    )
    by_two = psnr(render_target(of_two.need_gaussians(), pair.targets, 0).rgb, truth, pair.targets.valid[0])
    assert scores["pairs"]["psnr"] == pytest.approx(by_two, abs=1e-3)
    assert scores["oracle_plane"]["psnr"] >= scores["nearest"]["psnr"] > 5
    mean = np.mean([target["scores"]["model"]["psnr"] for target in window["targets"]])
    assert content["mean"]["3"]["model"]["psnr"] == pytest.approx(mean)

    (triple,) = entry["cases"]["2"]
    assert triple["context"] == ["000.png", "004.png"] and triple["targets"][0]["name"] == "002.png"
    assert cv2.imread("out/room-2-000-002.png").shape == (64, 5 * 96 + 4 * 4, 3)
    assert cv2.imread("out/room-3-000-003.png").shape == (64, 4 * 96 + 3 * 4, 3)
    printed = capsys.readouterr().out
    assert "mean of 1" in printed and "wrote out/results.json" in printed


def test_contradicted_gaussians_are_left_out_if_asked_for(
    capture_file: Path, scene: Path, repository: tuple[Path, str], exported: tuple[Path, Path], capsys: Capsys
) -> None:
    out = capture_file.parent / "out"
    options = ("--checkouts", repository[0].parents[1], "--model", exported[0], "--out", out, "--views", "3")
    assert run_command(main, "captures", *options, "--remove-contradicted") == 0
    (entry,) = json.loads((out / "results.json").read_text())["captures"]
    (window,) = entry["cases"]["3"]

    opened = Predictor(exported[0])
    (capture,) = read_captures()
    names, held_out = ["000.png", "002.png", "004.png"], ["001.png"]
    case = CaptureImages(capture, scene / "images", (64, 96)).case(names, held_out, opened.depth_range)
    context = case.context
    made = opened.predict_arrays(context.images, context.extrinsics, context.intrinsics, case.near, case.far)
    kept, removed = filter_gaussians(
        made.need_gaussians(),
        made.depth,
        context.extrinsics,
        context.intrinsics,
        FilterOptions(remove_contradicted=True),
        images=context.images,
    )
    assert removed["remove_contradicted"] > 0
    expected = psnr(render_target(kept, case.targets, 0).rgb, case.targets.image(0), case.targets.valid[0])
    assert window["targets"][0]["scores"]["model"]["psnr"] == pytest.approx(expected, abs=1e-3)


def test_a_render_is_compared_in_the_mean_exposure_of_the_two_views_around() -> None:
    # Photographs of gains 1, 0.5 and 0.25: the corrections of their exposure are 1, 2 and 4.
    exposure = Exposure(np.array([[1.0] * 3, [2.0] * 3, [4.0] * 3]), np.zeros((3, 3)))
    gaussian = Gaussians(*(np.ones(shape, np.float32) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1, 1, 3))))
    scene = Scene(gaussian, exposure, 0.0)
    white = np.ones((2, 2, 3))
    np.testing.assert_allclose(scene.in_exposure_of(white, [1, 2]), (0.5 + 0.25) / 2)


def test_input_views_are_compared_in_the_common_exposure_and_each_in_its_own() -> None:
    # A grey wall, 0.5, before two cameras at one place. The second photograph is half as bright: its correction is 2.
    exposure = Exposure(np.array([[1.0] * 3, [2.0] * 3]), np.zeros((2, 3)))
    one = np.ones((1, 1), np.float32)
    wall = Gaussians(one * [[0, 0, 5]], one * [[99] * 3], one * [[1, 0, 0, 0]], one[0], np.zeros((1, 1, 3), np.float32))
    images = np.ones((2, 3, 4, 4), np.float32) * np.float32([0.5, 0.25])[:, None, None, None]
    poses, K = np.stack([np.eye(4)] * 2), np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    context = PosedImages(["0", "1"], images, poses, np.stack([K] * 2), np.ones((2, 4, 4), bool))
    common, own = input_psnr(Scene(wall, exposure, 0.0), context)
    alone = psnr(render_target(wall, context, 0).rgb, context.image(0), context.valid[0])
    assert own > alone > 30
    assert common == pytest.approx((alone - 20 * np.log10(0.25)) / 2, abs=0.2)


def test_exposure_is_compensated_unless_it_is_switched_off(
    capture_file: Path, scene: Path, exported: tuple[Path, Path]
) -> None:
    predictor = Predictor(exported[0])
    (capture,) = read_captures()
    case = CaptureImages(capture, scene / "images", (64, 96)).case(NAMES[:2], NAMES[2:3], predictor.depth_range)
    darker = case.context.images * np.float32([1.0, 0.7])[:, None, None, None]
    case = replace(case, context=replace(case.context, images=darker))
    plan = make_plan("fast", predictor.model, "0", FilterOptions(), 0)
    for mode in ExposureMode:
        scene_of_two = CaptureEvaluator(predictor, {}, plan, mode).predict(case)
        assert scene_of_two.exposure.is_identity is (mode is ExposureMode.OFF)


def test_views_with_defects_are_left_out_of_a_window_with_the_frames_beside_them(
    capture_file: Path, scene: Path, exported: tuple[Path, Path], tmp_path: Path
) -> None:
    shutil.copytree(scene / "images", tmp_path / "images")
    cv2.imwrite(str(tmp_path / "images" / NAMES[0]), np.zeros((96, 128, 3), np.uint8))
    (capture,) = read_captures()
    predictor = Predictor(exported[0])
    plan = make_plan("fast", predictor.model, "0", FilterOptions(), 0)
    images = CaptureImages(capture, tmp_path / "images", (64, 96))
    (window,) = CaptureEvaluator(predictor, {}, plan).evaluate(capture, images, [3]).cases[3]
    assert window.left_out == NAMES[:1] and window.context == [NAMES[2], NAMES[4]]
    (target,) = window.targets
    assert target.name == NAMES[3]
    for metric, value in target.scores["pairs"].items():  # what is left are the two around
        assert target.scores["model"][metric] == pytest.approx(value, abs=1e-6), metric


@pytest.mark.slow
def test_bad_frames_are_found_and_good_ones_are_not(
    capture_file: Path, repository: tuple[Path, str], capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = json.loads(capture_file.read_text())
    document["captures"].append({**document["captures"][0], "name": "same room"})  # stands for another scene
    capture_file.write_text(json.dumps(document))
    kinds = {kind: spoiled.SPOILED[kind] for kind in ("black", "out of focus, radius 8 pixels")}
    monkeypatch.setattr(spoiled, "SPOILED", kinds)
    options = ("--checkouts", repository[0].parents[1], "--capture", "room", "--frames", "3")
    assert run_command(spoiled.main, *options) == 0
    printed = capsys.readouterr().out
    assert "false alarms: 0 of 5 frames beside all others, 0 of 5 in pairs alone" in printed
    for kind in kinds:
        (row,) = [line for line in printed.splitlines() if kind in line]
        beside, alone, tried = (int(word) for word in row.replace(kind, "").split() if word.isdigit())
        assert beside == alone == tried > 0


@pytest.mark.parametrize("module", [spoiled, choose])
def test_an_unknown_capture_is_refused_before_anything_is_read(module: Any, tmp_path: Path, capsys: Capsys) -> None:
    work = ("--work", tmp_path / "work") if module is choose else ()
    assert run_command(module.main, "--checkouts", tmp_path / "none", "--capture", "nowhere", *work) == 2
    assert "--capture nowhere: no such capture; expected one of " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_frames_can_only_be_kept_of_a_capture_that_was_chosen(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capsys
) -> None:
    file = tmp_path / "captures.json"
    file.write_text('{"captures": []}')
    monkeypatch.setattr(choose, "CAPTURES_FILE", file)
    options = ("--checkouts", tmp_path / "none", "--work", tmp_path / "work", "--capture", "city", "--keep-frames")
    assert run_command(choose.main, *options) == 2
    assert "has no frames of city; choose them first" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [file]


def test_a_kept_frame_needs_a_camera() -> None:
    chosen = {"name": "room", "triples": [["a", "c", "b"]], "views": ["a", "c"], "between": ["b"]}
    assert choose.kept_frames(chosen, ["a", "b", "c"]) == ([(0, 2, 1)], [0, 2], [1])
    with pytest.raises(InputError, match="room: frame b got no camera; choose without --keep-frames"):
        choose.kept_frames(chosen, ["a", "c"])


def test_pixels_outside_the_lens_image_are_invalid(capture_file: Path, scene: Path) -> None:
    content = json.loads(capture_file.read_text())
    content["captures"][0]["lenses"][0]["distortion"] = [0.3, 0.0, 0.0, 0.0]  # the corners lie outside
    capture_file.write_text(json.dumps(content))
    (capture,) = read_captures()
    images = CaptureImages(capture, scene / "images", (64, 96))
    case = images.case(NAMES[:2], NAMES[2:3], lambda views: captures.DepthRange(1, 2, "given"))
    assert not case.targets.valid[0, 0, 0] and case.targets.valid[0, 32, 48]
    assert 0.5 < case.targets.valid.mean() < 0.99


def test_cropped_images_are_those_of_the_crop(capture_file: Path, scene: Path, tmp_path: Path) -> None:
    content = json.loads(capture_file.read_text())
    entry, (left, top, right, bottom) = content["captures"][0], (12, 4, 84, 60)
    entry["crop"] = [left, top, right, bottom]
    (lens,) = entry["lenses"]
    fx, fy, cx, cy = lens["K"]
    lens.update(width=right - left, height=bottom - top, K=[fx, fy, cx - left, cy - top])
    capture_file.write_text(json.dumps(content))
    (capture,) = read_captures()
    whole = cv2.imread(str(scene / "images" / NAMES[0]))[..., ::-1]
    images = CaptureImages(capture, scene / "images", (bottom - top, right - left))
    case = images.case(NAMES[:2], NAMES[2:3], lambda views: captures.DepthRange(1, 2, "given"))
    np.testing.assert_array_equal(np.rint(255 * case.context.image(0)), whole[top:bottom, left:right])
    np.testing.assert_allclose(case.context.K(0), [[fx, 0, cx - left], [0, fy, cy - top], [0, 0, 1]], rtol=1e-5)
    (image, camera), _ = images.pairs(NAMES[:2])
    np.testing.assert_array_equal(image, whole[top:bottom, left:right])
    assert (camera.width, camera.height) == (72, 56)


def changed(field: str, value: object) -> str:
    content = json.loads(captures.CAPTURES_FILE.read_text())
    content["captures"][0][field] = value
    return json.dumps(content)


BAD_FILES = {
    "not JSON": (lambda: "{", "not valid JSON"),
    "another file": (lambda: '{"format": "other"}', "update idesplat"),
    "no captures": (lambda: '{"format": "idesplat-captures", "version": 1, "captures": []}', "at least one"),
    "a crop of nothing": (lambda: changed("crop", [10, 0, 10, 50]), "crop is"),
    "a crop that is no numbers": (lambda: changed("crop", "left"), "crop is"),
    "no lens": (lambda: changed("lenses", []), "room: is not as this version writes it"),
    "a frame without camera": (lambda: changed("triples", [["000.png", "004.png", "x.png"]]), "x.png: no camera"),
    "a context frame held out": (lambda: changed("triples", [["000.png"] * 3]), "is context and target"),
    "a view held out": (lambda: changed("between", NAMES[:2]), "none of them a view"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_damaged_file_of_captures_is_refused(name: str, capture_file: Path) -> None:
    text, expected = BAD_FILES[name]
    capture_file.write_text(text())
    with pytest.raises(InputError, match=expected):
        read_captures()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--capture", "nowhere"), "--capture nowhere: no such capture; expected one of room"),
        (("--views", "1"), "--views 1: expected numbers from 2 to 24"),
        (("--views", "2,²"), "expected numbers from 2 to 24"),
        (("--size", "60x50"), "multiples of"),
        (("--model", "none.onnx"), "none.onnx"),
    ],
)
def test_bad_options_are_one_line(
    arguments: tuple[str, ...], expected: str, capture_file: Path, exported: tuple[Path, Path], capsys: Capsys
) -> None:
    options = ("--out", capture_file.parent / "out", "--checkouts", capture_file.parent / "none")
    assert run_command(main, "captures", "--model", exported[0], *options, *arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and expected in lines[0]


def test_view_counts_are_sorted_once_each() -> None:
    assert parse_view_counts("6, 2,3,2") == [2, 3, 6]


def test_clones_go_to_our_own_cache_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert checkouts.clones_folder() == tmp_path / "idesplat" / "captures"
