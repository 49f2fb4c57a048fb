"""Validation on real captures in training: what is logged, and which folders are refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from idesplat.model.checkpoint import load_checkpoint
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.normalization import SceneNormalization
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.depth_range import DepthRange
from idesplat.tools.evaluation import metrics
from idesplat.tools.evaluation.captures.capture import CaptureImages, read_captures
from idesplat.tools.evaluation.novel_views import render_target
from idesplat.tools.training import trainer
from idesplat.tools.training.capture_validation import check_not_trained_on
from idesplat.tools.training.options import Objective, Resources
from idesplat.tools.training.run_files import CHECKPOINT, LOG
from idesplat.tools.training.trainer import CAPTURES_PSNR, Trainer
from one_capture import commit_all, git, list_one_capture
from test_train import SETTINGS, SMALL, logged, one_thread, refused

__all__ = ["one_thread"]  # a fixture
TWO_STEPS = replace(SETTINGS, steps=2, batch=1)
TRIPLE = ["000.png", "004.png", "002.png"]
NEAR_FAR = 1.5, 12.0


@pytest.fixture
def checkouts(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the checkout of the one capture that there is: the scene, with one triple."""
    folder = tmp_path / "checkouts"
    root = folder / "someone+photos"
    shutil.copytree(scene, root)
    fields = {
        **{"repository": "someone/photos", "commit": commit_all(root), "folder": "images"},
        **{"triples": [TRIPLE], "views": TRIPLE[:2], "between": TRIPLE[2:]},
    }
    list_one_capture(tmp_path / "captures.json", scene, fields, monkeypatch, NEAR_FAR)
    return folder


@torch.no_grad()
def psnr_by_hand(checkpoint: Path, scene: Path) -> float:
    """The held-out image's PSNR by the rasteriser and the metric of the evaluation, in the capture's own unit."""
    (capture,) = read_captures()
    images = CaptureImages(capture, scene / "images", (64, 64))
    case = images.case(TRIPLE[:2], TRIPLE[2:], lambda _: DepthRange(*NEAR_FAR, "the cameras"))
    context = case.context
    unit = SceneNormalization(context.extrinsics[:, :3, 3].mean(0), SMALL.near / NEAR_FAR[0])
    poses = torch.from_numpy(unit.apply(context.extrinsics))
    near, far = (torch.full((2,), depth * unit.scale) for depth in NEAR_FAR)
    lenses = torch.from_numpy(context.intrinsics).float()
    predicted = load_checkpoint(checkpoint, SMALL).eval()(torch.from_numpy(context.images), poses, lenses, near, far)
    arrays = {name: value.numpy() for name, value in predicted.gaussians._asdict().items()}
    rendered = render_target(unit.invert(Gaussians(**arrays)), case.targets, 0).rgb
    return metrics.psnr(rendered, case.targets.image(0), case.targets.valid[0])


@pytest.mark.slow
def test_the_psnr_of_the_held_out_image_is_logged_and_shown(
    checkouts: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in the first phase, which trains no Gaussians. The run is stopped in the second step and resumed."""
    plotted: list[str] = []
    monkeypatch.setattr(trainer, "write_curves", lambda path, entries, names: plotted.extend(names))

    def stop(entry: dict[str, float]) -> None:
        if entry["step"] == 2:
            raise KeyboardInterrupt

    out = tmp_path / "run"
    out.mkdir()
    with pytest.raises(KeyboardInterrupt):
        Trainer(out, TWO_STEPS, SMALL, captures=checkouts).fit(save_every=0, validate_every=1, on_step=stop)
    expected = [psnr_by_hand(out / CHECKPOINT, scene)]  # saved after the first step
    Trainer(out, TWO_STEPS, SMALL, captures=checkouts).fit(save_every=1e9, validate_every=1)
    expected.append(psnr_by_hand(out / CHECKPOINT, scene))
    assert [entry[CAPTURES_PSNR] for entry in logged(out)] == pytest.approx(expected, abs=0.01)
    assert CAPTURES_PSNR in plotted


@pytest.mark.slow
def test_without_the_folder_nothing_is_logged(tmp_path: Path) -> None:
    Trainer(tmp_path, replace(TWO_STEPS, steps=1), SMALL).fit(save_every=1e9, validate_every=1)
    assert CAPTURES_PSNR not in logged(tmp_path)[0]


def test_a_folder_without_captures_is_refused_at_the_start(checkouts: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    message = refused(out=tmp_path / "run", preset="idesplat-tiny", validate_captures=empty)
    assert f"--validate-captures {empty}: contains no validation capture" in message and "someone+photos" in message
    assert not (tmp_path / "run" / LOG).exists()


def test_a_checkout_without_the_commit_is_refused_at_the_start(checkouts: Path, tmp_path: Path) -> None:
    shutil.rmtree(checkouts / "someone+photos" / ".git")
    git(checkouts / "someone+photos", "init", "--quiet")
    with pytest.raises(InputError, match="expected the pinned commit"):
        Trainer(tmp_path, SETTINGS, SMALL, captures=checkouts)


def test_validation_captures_are_not_trained_on(checkouts: Path, tmp_path: Path) -> None:
    """Neither in the folder nor where a link in it leads to, as images or as textures."""
    data = checkouts / "someone+photos"
    options = {"out": tmp_path / "run", "objective": Objective.PHOTOMETRIC, "data": [data]}
    message = refused(**options, validate_captures=checkouts)
    assert message.startswith(f"--data {data}: is a folder of the validation captures, which are never trained on")
    inside = {**options, "data": [data / "images"]}  # has no cameras, which is not what is reported
    assert "never trained on" in refused(**inside, validate_captures=checkouts)
    links = tmp_path / "links"
    links.mkdir()
    (links / data.name).symlink_to(data)
    assert "never trained on" in refused(**options, validate_captures=links)
    with pytest.raises(InputError, match="--textures"):
        check_not_trained_on(replace(SETTINGS, textures=str(data / "images")), [checkouts])
    check_not_trained_on(replace(SETTINGS, textures=str(tmp_path / "textures")), [checkouts])


@pytest.mark.slow
def test_the_first_process_alone_renders_captures(checkouts: Path, tmp_path: Path) -> None:
    """The other process has the list of the package, of whose captures the folder holds none."""
    settings = replace(TWO_STEPS, steps=1, batch=2)
    resources = Resources(processes=2)
    trainer.train(settings, tmp_path, config=SMALL, resources=resources, captures=checkouts, validate_every=1)
    assert logged(tmp_path)[0][CAPTURES_PSNR] > 0
