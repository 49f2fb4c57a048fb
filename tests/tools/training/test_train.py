"""Training: losses by hand, a few optimiser steps, resumed runs, and invalid input."""

import json
import math
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch
from idesplat.model.checkpoint import load_checkpoint
from idesplat.model.config import DPTConfig, UNetConfig, ViTConfig
from idesplat.model.idesplat.config import DPBUConfig, FocusConfig, IDESplatConfig, PhotoConfig
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.errors import InputError
from idesplat.runtime.views.batch import ViewBatch, build_view_batch
from idesplat.tools.perceptual import load_lpips
from idesplat.tools.synthetic.make_scene import make_scene
from idesplat.tools.training import cli, losses, trainer
from idesplat.tools.training.data import captures
from idesplat.tools.training.data.captures import CaptureScenes
from idesplat.tools.training.data.samples import SampleSpec, prefetch
from idesplat.tools.training.data.synthetic import generate_views, training_spec
from idesplat.tools.training.initialization import new_model
from idesplat.tools.training.log import TrainingLog
from idesplat.tools.training.options import Device, Objective, Part
from idesplat.tools.training.run_files import CHECKPOINT, CURVES, LOG, PREDICTIONS
from idesplat.tools.training.schedule import Phase, lr_factor, phase_at, training_phases
from idesplat.tools.training.settings import TrainingSettings
from idesplat.tools.training.state import TrainingState
from idesplat.tools.training.step import scene_loss, with_input_views
from idesplat.tools.training.trainer import Trainer
from shared_fixtures import build_once

SMALL = IDESplatConfig(
    backbone_channels=(8, 8, 16),
    feature_channels=16,
    transformer_layers=2,
    transformer_ffn_ratio=1,
    vit=ViTConfig(dim=16, depth=4, heads=2, mlp_ratio=2, grid=5, out_indices=(0, 1, 2, 3)),
    dpt=DPTConfig(features=8, channels=(8, 8, 8, 8), disparity_channels=8),
    dpbus=(
        DPBUConfig(channels=16, candidates=17, scale=1, unet=UNetConfig(channels=16, levels=2)),
        DPBUConfig(channels=16, candidates=9, scale=2, unet=UNetConfig(channels=8, levels=3)),
        DPBUConfig(channels=8, candidates=5, scale=4, unet=UNetConfig(channels=8, levels=4)),
    ),
    residual_unet=UNetConfig(channels=8, levels=4),
    focus=FocusConfig(channels=16, window=4, topk=(16, 16, 8, 8)),
    sh_degree=1,
)
EVERYTHING = Phase(1.0, dpbus=3, gaussians=True, downsample=1)
SETTINGS = TrainingSettings(
    "small", "both", True, steps=8, batch=2, size=64, lr=1e-3, vit_lr=5e-4, seed=3, init="", data=[]
)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """One PyTorch thread, as in training; afterwards the settings that other tests expect."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    torch.set_flush_denormal(False)


def test_tiny_preset_is_small_and_complete() -> None:
    config = PRESETS["idesplat-tiny"]
    with torch.device("meta"):
        model, released = IDESplat(config), IDESplat(PRESETS["idesplat-re10k"])
    assert sum(parameter.numel() for parameter in model.parameters()) <= 4_000_000
    assert {type(part) for part in released.modules()} <= {type(part) for part in model.modules()}
    assert 256 % config.size_multiple == 0 and config.size_multiple == 32


def test_inverse_depth_loss_grows_with_the_error() -> None:
    truth = torch.rand(2, 1, 8, 8) + 0.1
    bins = torch.full((2, 1, 1, 1), 0.05)
    assert losses.inverse_depth_loss(truth, truth, bins) == 0
    costs = [float(losses.inverse_depth_loss(truth + error, truth, bins)) for error in (0.001, 0.01, 0.1, 1.0)]
    assert costs == sorted(costs)
    # A small constant error has no gradient along x and y.
    by_hand = 0.001 / 0.05 + losses.RELATIVE_WEIGHT * (1 + 0.001 / truth).log().mean()
    assert costs[0] == pytest.approx(float(by_hand), rel=0.02)


def test_cross_entropy_by_hand() -> None:
    """Candidates 0, 1, 2: the target of truth 1.25 is 0.75 on candidate 1 and 0.25 on candidate 2."""
    probability = torch.tensor([0.2, 0.5, 0.3]).reshape(1, 3, 1, 1)
    candidates = torch.tensor([0.0, 1.0, 2.0]).reshape(1, 3, 1, 1)
    found = losses.candidate_cross_entropy(probability, candidates, torch.full((1, 1, 1, 1), 1.25))
    assert float(found) == pytest.approx(-0.75 * math.log(0.5) - 0.25 * math.log(0.3))
    assert losses.candidate_cross_entropy(probability, candidates, torch.full((1, 1, 1, 1), 2.5)) == 0  # outside


def test_offset_prior_by_hand() -> None:
    raw = torch.randn(2, 22, 3, 4)
    raw[:, 1:3] = 0.0
    assert losses.offset_prior(raw) == 0
    raw[:, 1] = math.log(3)  # sigmoid 0.75, of x alone
    assert float(losses.offset_prior(raw)) == pytest.approx(losses.OFFSET_WEIGHT * 0.25 / 2, rel=1e-5)


def test_photometric_loss_by_hand() -> None:
    """Two images with errors of 0.1 and 1 everywhere: r(MSE) = 3e-3 * log(1 + MSE / 3e-3)."""
    truth = torch.zeros(2, 3, 4, 4)
    rendered = truth + torch.tensor([0.1, 1.0])[:, None, None, None]
    expected = 0.003 * (math.log(1 + 0.01 / 0.003) + math.log(1 + 1 / 0.003)) / 2
    assert float(losses.photometric_loss(rendered, truth, None)) == pytest.approx(expected, rel=1e-5)
    weighted = losses.photometric_loss(rendered, truth, lambda a, b: (a - b).mean())
    assert float(weighted) == pytest.approx(expected + losses.LPIPS_WEIGHT * 0.55, rel=1e-5)


def test_a_context_view_is_appended_to_the_targets() -> None:
    views = generate_views(SampleSpec(11, 2, (1, 2), 32, 32))
    shown = with_input_views(views, 1)
    assert torch.equal(shown.target_images[:2], views.target_images) and len(shown.target_images) == 3
    assert torch.equal(shown.target_images[2], views.images[1])
    assert torch.equal(shown.target_extrinsics[2], views.extrinsics[1])
    assert torch.equal(shown.target_intrinsics[2], views.intrinsics[1])
    both = with_input_views(views, 1, 2)
    assert torch.equal(both.target_images[2:], views.images[[1, 0]])
    assert torch.equal(both.target_extrinsics[2:], views.extrinsics[[1, 0]])


def test_monocular_loss_is_scale_invariant() -> None:
    truth = torch.rand(2, 8, 8) + 0.1
    scaled = SimpleNamespace(mono_disparity=0.37 * truth[:, None])
    flipped = SimpleNamespace(mono_disparity=truth.flip(2)[:, None])
    assert float(losses.monocular_loss(scaled, truth)) == pytest.approx(0, abs=1e-6)
    assert float(losses.monocular_loss(flipped, truth)) > 0.01


def test_truth_is_resized_with_aligned_corners() -> None:
    truth = torch.arange(64.0).reshape(1, 8, 8)
    assert losses.resize_truth(truth, 2, 2).flatten().tolist() == [0, 7, 56, 63]
    assert torch.equal(losses.resize_truth(truth, 8, 8)[:, 0], truth)


def test_new_network_decodes_correlations() -> None:
    """The U-Net of a new network has its maximum where the correlations have theirs."""
    model = new_model(PRESETS["idesplat-tiny"], seed=0)
    candidates = PRESETS["idesplat-tiny"].dpbus[0].candidates
    peaks = torch.randint(5, candidates - 5, (2, 1, 16, 16))
    scores = torch.zeros(2, candidates + 1, 16, 16)
    for shift in (-1, 0, 1):
        scores.scatter_(1, 1 + peaks + shift, 2.0 - abs(shift))
    with torch.no_grad():
        found = model.dpbu1.first.regulariser(scores, 2).argmax(1, keepdim=True)
    assert ((found - peaks).abs() <= 2).float().mean() > 0.9
    again, other = new_model(PRESETS["idesplat-tiny"], seed=0), new_model(PRESETS["idesplat-tiny"], seed=1)
    ours = model.encoder.backbone.conv1.weight
    assert torch.equal(ours, again.encoder.backbone.conv1.weight)
    assert not torch.equal(ours, other.encoder.backbone.conv1.weight)


def test_lpips_only_where_it_needs_no_download(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)  # not installed
    with pytest.raises(InputError, match="lpips is not installed"):
        load_lpips()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace())
    with pytest.raises(InputError, match="weights are not at"):
        load_lpips()


def test_curriculum_goes_from_coarse_to_fine_and_lr_decays() -> None:
    phases = training_phases(Objective.BOTH, curriculum=True)
    seen = [phase_at(phases, step, 100) for step in range(100)]
    assert seen[0].dpbus == 1 and seen[-1].dpbus == 3 and seen[-1].gaussians and seen[-1].downsample == 1
    assert [phase.dpbus for phase in seen] == sorted(phase.dpbus for phase in seen)
    depth = training_phases(Objective.DEPTH, curriculum=True)
    assert not any(phase.gaussians for phase in depth) and depth[-1].dpbus == 3 and depth[-1].downsample == 1
    assert depth[-1].end == 1 and depth[0].end == pytest.approx(0.57 / 0.87)
    assert training_phases(Objective.PHOTOMETRIC, curriculum=True) == (EVERYTHING,)
    rates = [lr_factor(phases, step, 1000) for step in range(1000)]
    peak = rates.index(max(rates))
    assert rates[peak] == 1 and rates[:peak] == sorted(rates[:peak]) and rates[peak:] == sorted(rates[peak:])[::-1]
    assert rates[0] > 0 and rates[-1] == pytest.approx(0.01, abs=1e-3)
    # Half the work is done: 0.57 + 0.14 + 0.30 + 1.43 + 1.95 = 4.39 in all, 1.01 of it before the last but one phase.
    half = next(step for step, rate in enumerate(rates) if step > peak and rate < 0.505)
    assert half == pytest.approx(1000 * (0.74 + (0.05 + (4.39 - 0.05) / 2 - 1.01) / 11), abs=1.5)


def test_images_of_many_views_are_smaller() -> None:
    """Six views of 192x192 have 3.4 times the pixels of a view of 256x256."""
    specs = [training_spec(5, step, 0, True, 256, 320, more_views=True) for step in range(200)]
    assert {(spec.context, spec.height, spec.width) for spec in specs} == {
        *((views, 256, 320) for views in (2, 3, 4)),
        (6, 192, 224),
    }
    two_views = (training_spec(5, step, 0, False, 256, 256, more_views=False) for step in range(200))
    assert {(spec.context, spec.height) for spec in two_views} == {(2, 256)}


def test_prefetched_samples_keep_their_order_and_repeat() -> None:
    specs = [training_spec(5, step, 0, True, 32, 32, more_views=True) for step in range(120)]
    assert specs == [training_spec(5, step, 0, True, 32, 32, more_views=True) for step in range(120)]
    assert len({spec.seed for spec in specs}) == 120 and {spec.context for spec in specs} == {2, 3, 4, 6}
    assert specs[7].context == training_spec(5, 7, 1, True, 32, 32, more_views=True).context
    loaded = list(prefetch(iter(specs[:7]), generate_views))
    for spec, views in zip(specs, loaded, strict=False):
        assert views.images.shape == (spec.context, 3, 32, 32)
        again = next(prefetch(iter([spec]), generate_views))
        assert torch.equal(views.images, again.images) and torch.equal(views.inverse_depth, again.inverse_depth)


@pytest.mark.slow
@pytest.mark.parametrize("objective", list(Objective))
def test_a_few_steps_on_one_scene_reduce_the_loss(objective: Objective) -> None:
    """Depth and novel views improve where the objective contains them."""
    state = TrainingState(SMALL, seed=0, lr=3e-3, vit_lr=3e-3)
    views = next(prefetch(iter([SampleSpec(11, 2, (1,), 64, 64)]), generate_views))
    phase = training_phases(objective, curriculum=False)[0]
    entries = []
    for _ in range(14):
        loss, entry = scene_loss(state.model, views, phase, objective, None)
        loss.backward()
        state.update(1.0)
        entries.append(entry)
    first, last = entries[0], entries[-1]
    assert last["loss"] < 0.8 * first["loss"]
    if objective is not Objective.PHOTOMETRIC:
        assert last["abs_rel"] < 0.8 * first["abs_rel"]
    if objective is not Objective.DEPTH:
        assert last["psnr"] > first["psnr"] + 1


def logged(folder: Path) -> list[dict[str, float]]:
    entries = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    return [{name: value for name, value in entry.items() if name != "seconds"} for entry in entries]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def run(folder: Path) -> None:
        torch.set_num_threads(1)
        Trainer(folder, SETTINGS, SMALL).fit(save_every=1e9, validate_every=4)

    return build_once(tmp_path_factory, "finished-training", run)


def test_run_writes_log_curves_and_predictions(finished: Path) -> None:
    entries = logged(finished)
    assert [entry["step"] for entry in entries] == list(range(1, 9))
    assert all(entry["loss"] > 0 for entry in entries) and "psnr" in entries[-1]
    assert [entry["step"] for entry in entries if "validation_abs_rel" in entry] == [4, 8]
    assert cv2.imread(str(finished / CURVES)).std() > 5
    predictions = cv2.imread(str(finished / PREDICTIONS))
    assert predictions.shape == (4 * 64, 6 * 64, 3) and predictions.std() > 5


def test_resumed_run_equals_uninterrupted(finished: Path, tmp_path: Path) -> None:
    """Stopped after step 5 was logged but not saved: the resumed run repeats it with equal results."""

    def stop(entry: dict[str, float]) -> None:
        if entry["step"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(tmp_path, SETTINGS, SMALL).fit(save_every=0, validate_every=4, on_step=stop)
    assert len(logged(tmp_path)) == 5
    with (tmp_path / LOG).open("a") as log:
        log.write('{"step": 6, "lo')  # an incomplete line
    Trainer(tmp_path, SETTINGS, SMALL).fit(save_every=1e9, validate_every=4)
    assert logged(tmp_path) == logged(finished)
    ours, theirs = (torch.load(folder / CHECKPOINT, weights_only=True) for folder in (tmp_path, finished))
    for name, value in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], value), name
        assert torch.equal(ours["training"]["weights"][name], theirs["training"]["weights"][name]), name


def test_curves_show_the_last_validation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[list[dict[str, float]]] = []
    monkeypatch.setattr(trainer, "write_curves", lambda path, entries, names: shown.append(list(entries)))
    Trainer(tmp_path, replace(SETTINGS, steps=1), SMALL).fit(save_every=1e9, validate_every=4)
    assert [entry["step"] for entry in shown[-1]] == [1] and "validation_abs_rel" in shown[-1][0]


def test_run_stopped_before_the_next_checkpoint_repeats_its_command(tmp_path: Path) -> None:
    """The first step is saved: without a checkpoint the log would be a file of the user's that would be replaced."""

    def stop(entry: dict[str, float]) -> None:
        if entry["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(tmp_path, SETTINGS, SMALL).fit(save_every=1e9, validate_every=4, on_step=stop)
    resumed = Trainer(tmp_path, SETTINGS, SMALL)
    assert resumed.state.step == 1 and len(logged(tmp_path)) == 1


def test_a_stopped_run_leaves_no_thread(tmp_path: Path) -> None:
    """Also while the exception, which refers to the run's frames, is kept."""

    def stop(entry: dict[str, float]) -> None:
        assert loaders()
        raise KeyboardInterrupt

    def loaders() -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread.name.startswith("samples")]

    with pytest.raises(KeyboardInterrupt) as stopped:
        Trainer(tmp_path, SETTINGS, SMALL).fit(save_every=1e9, validate_every=4, on_step=stop)
    assert not loaders(), stopped


@pytest.mark.parametrize("quiet", (False, True))
def test_quiet_runs_show_no_progress(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", terminal)
    with cli._progress_bar(2, quiet) as on_step:
        on_step({"step": 1, "loss": 3.0})
    assert ("loss 3.000" in terminal.getvalue()) != quiet


def test_checkpoint_holds_the_ema_and_loads_strictly(finished: Path) -> None:
    """The strict loader of the exporter finds the EMA of the weights."""
    model = load_checkpoint(finished / CHECKPOINT, SMALL)
    content = torch.load(finished / CHECKPOINT, weights_only=True)
    weights = content["training"]["weights"]
    found = model.state_dict()
    assert all(torch.equal(found[name], value) for name, value in content["state_dict"].items())
    assert found.keys() == weights.keys()
    assert any(not torch.equal(found[name], value) for name, value in weights.items())


def test_interrupted_write_keeps_the_previous_checkpoint(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / CHECKPOINT
    path.write_bytes((finished / CHECKPOINT).read_bytes())
    state = TrainingState(SMALL, seed=9, lr=1e-3, vit_lr=1e-3)

    def half(content: object, file: Path) -> None:
        Path(file).write_bytes(b"PK half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(KeyboardInterrupt):
        state.save(path, asdict(SETTINGS))
    assert [file.name for file in tmp_path.iterdir()] == [CHECKPOINT]
    state.resume(path, asdict(SETTINGS))
    assert state.step == SETTINGS.steps


@pytest.mark.slow
def test_killed_process_leaves_a_valid_checkpoint(tmp_path: Path) -> None:
    """SIGKILL at an arbitrary moment of a run that writes its checkpoint at every step."""
    options = {"steps": 500, "size": 64, "batch": 1, "save-every": 0}
    arguments = [f"--{name}={value}" for name, value in options.items()]
    command = [
        sys.executable,
        "-m",
        "idesplat.tools.training.cli",
        f"--out={tmp_path}",
        "--objective=depth",
        *arguments,
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        while not (tmp_path / CHECKPOINT).exists() or len(logged(tmp_path)) < 4:
            assert process.poll() is None, process.stderr.read().decode()
            time.sleep(0.05)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    model = load_checkpoint(tmp_path / CHECKPOINT, PRESETS["idesplat-tiny"])
    assert all(value.isfinite().all() for value in model.state_dict().values())
    training = torch.load(tmp_path / CHECKPOINT, weights_only=True)["training"]
    assert 1 <= training["step"] <= len(logged(tmp_path))


def test_log_drops_entries_after_the_checkpoint(tmp_path: Path) -> None:
    log = TrainingLog(tmp_path / LOG, 0)
    for step in (1, 2, 3):
        log.add({"step": step, "loss": 1.0 / step})
    assert [entry["step"] for entry in TrainingLog(tmp_path / LOG, 2).entries] == [1, 2]
    assert len((tmp_path / LOG).read_text().splitlines()) == 2


def refused(**options: object) -> str:
    """The error message of the command with these options, one line."""
    with pytest.raises(InputError) as error:
        cli.train(**options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_bad_inputs_are_one_line_each(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    assert "idesplat-tiny" in refused(out=out, preset="idesplat-huge")
    assert "no such preset" in refused(out=out, preset="depthsplat-small-re10k")
    assert "multiple of 64" in refused(out=out, size="200")
    for size in ("64x128", "32", "32x32"):
        assert f"--size {size}: expected a square with sides of 64 pixels at least" in refused(out=out, size=size)
    assert "nothing would be trained" in refused(out=out, lr=0.0, vit_lr=0.0)
    assert "use photometric" in refused(out=out, data=[tmp_path])
    assert "cannot be read" in refused(out=out, data=[tmp_path], objective=Objective.PHOTOMETRIC)
    assert "no such file" in refused(out=out, init=tmp_path / "absent.ckpt")
    assert "does not fit the network" in refused(out=out, init=finished / CHECKPOINT)
    assert "other settings" in refused(out=finished, steps=9)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "--device cuda: PyTorch" in refused(out=out, device=Device.CUDA)
    head = {"part": Part.HEAD, "init": finished / CHECKPOINT}
    assert "--train head runs on the CPU" in refused(out=out, device=Device.CUDA, **head)
    (tmp_path / CHECKPOINT).write_bytes(b"not a checkpoint")
    assert "not a checkpoint of a training run" in refused(out=tmp_path)
    torch.save({"state_dict": {}}, tmp_path / CHECKPOINT)
    assert "not a checkpoint of a training run" in refused(out=tmp_path)
    assert "is not a folder" in refused(out=tmp_path / CHECKPOINT / "below")
    assert not out.exists() or not list(out.iterdir())


@pytest.mark.slow
def test_captures_are_supervised_by_target_views_alone(scene: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, objective="photometric", steps=2, data=[str(scene)])
    Trainer(tmp_path, settings, SMALL).fit(save_every=1e9, validate_every=2)
    entries = logged(tmp_path)
    assert all(entry["psnr"] > 0 and "abs_rel" not in entry for entry in entries)
    assert entries[-1]["validation_psnr"] > 0
    assert cv2.imread(str(tmp_path / PREDICTIONS)).shape == (4 * 64, 4 * 64, 3)


def test_capture_samples_follow_their_spec(scene: Path) -> None:
    scenes = CaptureScenes([scene], near=1, far=20)
    spec = SampleSpec(5, 2, (1,), 64, 96)
    first, again = scenes.load(spec), scenes.load(spec)
    assert torch.equal(first.images, again.images) and torch.equal(first.target_images, again.target_images)
    assert first.images.shape == (2, 3, 64, 96) and first.target_images.shape == (1, 3, 64, 96)
    centres = torch.cat([first.extrinsics, first.target_extrinsics])[:, :3, 3]
    assert len(centres.unique(dim=0)) == 3
    zoomed = scenes.load(replace(spec, target_zooms=(2,)))
    corner = (2 * first.target_intrinsics[0, :2, 2] - zoomed.target_intrinsics[0, :2, 2]).numpy()  # in crop sizes
    left, top = (corner * (96, 64)).round().astype(int)
    shown = first.target_images[0].repeat_interleave(2, 1).repeat_interleave(2, 2)
    shown = shown[:, top : top + 64, left : left + 96]
    assert torch.equal(first.images, zoomed.images) and (left > 0 or top > 0)
    assert (zoomed.target_images[0] - shown).abs().mean() < 0.05
    assert len(scenes.load(SampleSpec(5, 4, (1, 2), 64, 96)).images) == 2  # 4 images are not held out


def test_validation_renders_held_out_images(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of five images, the first is held out."""
    used: dict[str, set[str]] = {"train": set(), "validate": set()}
    now = "train"
    opened = captures.load_view

    def noted(pair: tuple[Path, Camera], height: int, width: int) -> tuple:
        used[now].add(pair[0].name)
        return opened(pair, height, width)

    def noted_all(pairs: list[tuple[Path, Camera]], *rest: object) -> ViewBatch:
        if now == "train":
            used[now].update(path.name for path, _ in pairs)
        return build_view_batch(pairs, *rest)

    monkeypatch.setattr(captures, "load_view", noted)
    monkeypatch.setattr(captures, "build_view_batch", noted_all)
    settings = replace(SETTINGS, objective="photometric", data=[str(scene)])
    run = Trainer(tmp_path, settings, SMALL)
    for seed in range(40):
        run.source(SampleSpec(seed, 2, (1, 2), 64, 64))
    now = "validate"
    for seed in range(5):
        run.held_out(SampleSpec(seed, 2, (1,), 64, 64))
    assert used == {"train": {"001.png", "002.png", "003.png", "004.png"}, "validate": {"000.png"}}


def test_folder_with_too_few_images_is_refused(tmp_path: Path) -> None:
    make_scene(tmp_path, seed=2, views=4, height=32, width=48)
    with pytest.raises(InputError, match="3 images to train on and 1 held out for validation, expected at least"):
        CaptureScenes([tmp_path], near=1, far=20)


def test_missing_image_is_refused(scene: Path, tmp_path: Path) -> None:
    shutil.copy(scene / "transforms.json", tmp_path)
    with pytest.raises(InputError, match="which is not there"):
        CaptureScenes([tmp_path], near=1, far=20)


def test_init_loads_weights_and_starts_at_step_zero(finished: Path) -> None:
    state = TrainingState(SMALL, seed=1, lr=1e-3, vit_lr=1e-3)
    state.start_from(finished / CHECKPOINT)
    expected = load_checkpoint(finished / CHECKPOINT, SMALL).state_dict()
    assert state.step == 0
    assert all(torch.equal(value, expected[name]) for name, value in state.model.state_dict().items())


def test_init_replaces_the_vit_by_photographic_features(finished: Path) -> None:
    config = replace(SMALL, photo=PhotoConfig(channels=SMALL.vit.dim, features=SMALL.dpt.features))
    state = TrainingState(config, seed=1, lr=1e-3, vit_lr=1e-3)
    made = {name: value.clone() for name, value in state.model.state_dict().items()}
    state.start_from(finished / CHECKPOINT)
    kept = load_checkpoint(finished / CHECKPOINT, SMALL).state_dict()
    merged = tuple(f"dpbu{number}.merge.conv.weight" for number in (1, 2, 3))
    for name, value in state.model.state_dict().items():
        if name in merged:
            mono = sum(config.mono_channels)
            assert torch.equal(value[:, :-mono], kept[name][:, :-mono]) and not value[:, -mono:].any()
        else:
            assert torch.equal(value, made[name] if name.startswith("encoder.photo.") else kept[name]), name
