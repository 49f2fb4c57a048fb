"""Training of the Gaussian head alone: frozen parts, cached features, reset of saturated opacities."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from idesplat.model.common.gaussian_adapter import SCALE_SHIFT
from idesplat.tools.training import head as head_training
from idesplat.tools.training.data.samples import SampleSpec, TrainingViews
from idesplat.tools.training.data.synthetic import generate_views
from idesplat.tools.training.head import (
    HEAD_PREFIXES,
    SCALE_GAIN,
    START_OPACITY,
    FeatureCache,
    HeadSample,
    head_loss,
    head_spec,
    reset_opacity,
    scene_index,
)
from idesplat.tools.training.initialization import new_model
from idesplat.tools.training.options import Part
from idesplat.tools.training.run_files import CHECKPOINT, FEATURES
from idesplat.tools.training.tasks import HeadTask
from idesplat.tools.training.trainer import Trainer
from test_train import SETTINGS, SMALL, finished, logged, one_thread, refused

pytestmark = pytest.mark.slow

__all__ = ["finished", "one_thread"]  # fixtures
CONFIG = replace(SMALL, cross_view_channels=4, scale_in_pixels=True)
HEAD = replace(SETTINGS, curriculum=False, steps=4, batch=1, part="head", scenes=3)


@pytest.fixture
def cache(tmp_path: Path) -> FeatureCache:
    return FeatureCache(tmp_path / "cache", new_model(CONFIG, seed=0), generate_views, "test")


def test_every_scene_is_used_once_per_epoch() -> None:
    indices = [scene_index(7, position, 5) for position in range(15)]
    assert [sorted(indices[epoch : epoch + 5]) for epoch in (0, 5, 10)] == [[0, 1, 2, 3, 4]] * 3
    assert len({tuple(indices[epoch : epoch + 5]) for epoch in (0, 5, 10)}) > 1


def test_specs_repeat_and_follow_the_probabilities() -> None:
    specs = [head_spec(3, index, 64, 64, 0.25) for index in range(400)]
    assert specs == [head_spec(3, index, 64, 64, 0.25) for index in range(400)]
    views = Counter(spec.context for spec in specs)
    assert views.keys() == head_training.VIEW_COUNT_PROBABILITIES.keys() and views[2] == pytest.approx(300, abs=30)
    assert sum(spec.real for spec in specs) == pytest.approx(100, abs=30)


def test_cached_features_give_the_same_gaussians(cache: FeatureCache) -> None:
    """Cached features give the same Gaussians as the full network, up to uint8 images and half precision."""
    spec = SampleSpec(11, 2, (1,), 64, 64)
    sample = cache.load(spec)
    views = generate_views(spec)
    with torch.no_grad():
        whole = cache.model(views.images, views.extrinsics, views.intrinsics, views.near, views.far)
        cameras = head_training.cameras_of(sample.views)
        cached = cache.model.gaussians.predict(sample.views.images, cameras, sample.inputs)
    assert torch.equal(cached.depth, whole.depth)
    assert (cached.raw - whole.raw).abs().max() < 0.05 * whole.raw.std()

    def fail(_: SampleSpec) -> TrainingViews:
        raise AssertionError("loaded again")

    again = FeatureCache(cache.folder.parent, cache.model, fail, "test").load(spec)
    assert torch.equal(again.inputs.context, sample.inputs.context)
    other = FeatureCache(cache.folder.parent, new_model(CONFIG, seed=1), fail, "test")
    with pytest.raises(AssertionError, match="loaded again"):  # other weights have another cache
        other.load(spec)


def test_only_saturated_opacity_is_reset(cache: FeatureCache) -> None:
    samples = [cache.load(SampleSpec(11, 2, (1,), 64, 64))]
    model = cache.model
    bias = model.gaussians.head2.bias
    assert bias is not None
    before = bias.detach().clone()
    reset_opacity(model, samples)
    assert torch.equal(bias, before)  # a new network's opacity is not saturated
    with torch.no_grad():
        bias[0] = 8.0
    _, scale_before = _opacity_and_scale(model, samples[0])
    reset_opacity(model, samples)
    opacity, scale = _opacity_and_scale(model, samples[0])
    assert opacity == pytest.approx(START_OPACITY, abs=0.02)
    assert scale == pytest.approx(SCALE_GAIN * scale_before, rel=0.02)


def _opacity_and_scale(model: torch.nn.Module, sample: HeadSample) -> tuple[float, float]:
    """Mean opacity and median scale in pixels."""
    with torch.no_grad():
        raw = model.gaussians.predict(sample.views.images, head_training.cameras_of(sample.views), sample.inputs).raw
    scales = torch.nn.functional.softplus(raw[:, 3:6] - SCALE_SHIFT)
    return float(raw[:, 0].sigmoid().mean()), float(scales.median())


def test_only_the_head_gets_gradients(cache: FeatureCache) -> None:
    loss, entry = head_loss(cache.model, cache.load(SampleSpec(11, 2, (1, 2), 64, 64)), 0, None)
    loss.backward()
    got = {name for name, p in cache.model.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}
    assert got and all(name.startswith(HEAD_PREFIXES) for name in got)
    assert any(name.startswith("gaussians.cross_view.") for name in got)
    assert entry["psnr"] > 0 and entry["input_psnr"] > 0 and 0 < entry["opacity"] < 1


def test_run_trains_the_head_alone_and_resumes(finished: Path, tmp_path: Path) -> None:
    settings = replace(HEAD, init=str(finished / CHECKPOINT))
    whole = tmp_path / "whole"
    whole.mkdir()
    Trainer(whole, settings, SMALL).fit(save_every=1e9, validate_every=4)
    before = torch.load(finished / CHECKPOINT, weights_only=True)["state_dict"]
    after = torch.load(whole / CHECKPOINT, weights_only=True)["state_dict"]
    changed = {name for name, value in after.items() if not torch.equal(value, before[name])}
    assert changed and all(name.startswith(HEAD_PREFIXES) for name in changed)
    assert len(list((whole / FEATURES).rglob("*.pt"))) == 3

    def stop(entry: dict[str, float]) -> None:
        if entry["step"] == 2:
            raise KeyboardInterrupt

    parts = tmp_path / "parts"
    parts.mkdir()
    with pytest.raises(KeyboardInterrupt):
        trainer = Trainer(parts, settings, SMALL, features=whole / FEATURES)
        trainer.fit(save_every=0, validate_every=4, on_step=stop)
    Trainer(parts, settings, SMALL, features=whole / FEATURES).fit(save_every=1e9, validate_every=4)
    assert logged(parts) == logged(whole)
    assert not (parts / FEATURES).exists()


def test_features_of_each_precision_and_zoom_are_cached_apart(finished: Path, tmp_path: Path) -> None:
    folders = set()
    for name, changes in (("float32", {}), ("bf16", {"precision": "bf16"}), ("closer", {"target_zoom": 2})):
        settings = replace(HEAD, init=str(finished / CHECKPOINT), **changes)
        (tmp_path / name).mkdir()
        task = Trainer(tmp_path / name, settings, SMALL, features=tmp_path / FEATURES).task
        assert isinstance(task, HeadTask)
        folders.add(task.cache.folder)
    assert len(folders) == 3


def test_head_training_needs_a_checkpoint(tmp_path: Path) -> None:
    assert "give a checkpoint with --init" in refused(out=tmp_path / "run", part=Part.HEAD)
