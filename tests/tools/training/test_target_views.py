"""The views that training renders: how much closer than the context, and how many context views beside novel ones."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from idesplat.model.idesplat.network import IDESplat
from idesplat.runtime.errors import InputError
from idesplat.tools.training import cli, head, step, trainer
from idesplat.tools.training.data.samples import SampleSpec, TrainingViews
from idesplat.tools.training.data.synthetic import generate_views, sample_target_zooms, training_spec
from idesplat.tools.training.head import HeadSample, head_loss, head_spec
from idesplat.tools.training.options import NO_TERMS, Objective, Part, TargetViews
from idesplat.tools.training.run_files import CHECKPOINT
from idesplat.tools.training.settings import network_config
from idesplat.tools.training.state import TrainingState
from idesplat.tools.training.step import scene_loss, with_input_views
from test_train import EVERYTHING, SETTINGS, SMALL

# Rendered images are black; each image has one value, and so the squared error of this value.
NOVEL, FIRST, SECOND = 0.1, 0.2, 0.3


def views_by_hand() -> TrainingViews:
    """Two context views and one novel view, each of one value."""
    context, target = (torch.full((1, 3, 4, 4), value) for value in (FIRST, NOVEL))
    images = torch.cat([context, torch.full((1, 3, 4, 4), SECOND)])
    poses, lenses = torch.eye(4).repeat(2, 1, 1), torch.eye(3).repeat(2, 1, 1)
    return TrainingViews(
        images, poses, lenses, torch.ones(2), torch.full((2,), 9.0), None, target, poses[:1], lenses[:1]
    )


def photometric_by_hand(*values: float) -> float:
    """The mean of r(e; 0.003) of the squared errors e of black images."""
    return sum(0.003 * math.log(1 + value**2 / 0.003) for value in values) / len(values)


def test_zooms_of_the_default_are_those_of_earlier_versions() -> None:
    """The random stream of a run is unchanged: these were found before the zoom was an option."""
    found = [training_spec(5, index, 1, True, 64, 64, True, 0.25) for index in range(6)]
    assert [spec.seed for spec in found] == [889984566, 887365237, 795629300, 247900169, 517477016, 504848612]
    assert [spec.target_zooms for spec in found] == [(1, zoom) for zoom in (4, 4, 3, 4, 4, 2)]
    assert [spec.real for spec in found] == [False, False, True, False, True, False]
    found = [head_spec(3, index, 64, 64, 0.25) for index in range(6)]
    assert [spec.seed for spec in found] == [179440734, 579224570, 566064569, 298087369, 584290193, 56654041]
    assert [spec.target_zooms for spec in found] == [(1, zoom) for zoom in (2, 3, 4, 2, 3, 4)]
    assert [spec.real for spec in found] == [False, False, False, False, True, False]


def test_the_closer_target_is_at_most_as_close_as_asked_for() -> None:
    rng = np.random.default_rng(0)
    found = {largest: {sample_target_zooms(rng, largest) for _ in range(200)} for largest in (1, 2, 3)}
    assert found == {1: {(1, 1)}, 2: {(1, 2)}, 3: {(1, 2), (1, 3)}}
    assert {training_spec(5, index, 0, True, 64, 64, True, target_zoom=1).target_zooms for index in range(9)} == {
        (1, 1)
    }
    assert {head_spec(5, index, 64, 64, 0.0, target_zoom=2).target_zooms for index in range(9)} == {(1, 2)}
    assert training_spec(5, 0, 0, False, 64, 64, True, target_zoom=1).target_zooms == ()


def test_targets_without_zoom_have_the_lens_of_the_context() -> None:
    """A crop of an image twice as large has twice the focal length."""
    same, closer = (generate_views(SampleSpec(11, 2, (1, zoom), 32, 32)) for zoom in (1, 2))
    assert same.target_images.shape == closer.target_images.shape == (2, 3, 32, 32)
    focal, closer_focal = (views.target_intrinsics[1, 0, 0] for views in (same, closer))
    assert float(closer_focal) == pytest.approx(2 * float(focal))


def test_as_many_input_views_are_appended_as_asked_for() -> None:
    views = views_by_hand()
    assert torch.equal(with_input_views(views, 1, 0).target_images, views.target_images)
    shown = {count: with_input_views(views, 1, count).target_images[:, 0, 0, 0] for count in (1, 2, 5)}
    assert torch.equal(shown[1], torch.tensor([NOVEL, SECOND]))
    assert torch.equal(shown[2], torch.tensor([NOVEL, SECOND, FIRST]))
    assert torch.equal(shown[5], shown[2])  # there are no more


@pytest.mark.parametrize("input_views, rendered", ((0, (NOVEL,)), (1, (NOVEL, SECOND)), (2, (NOVEL, SECOND, FIRST))))
def test_loss_of_all_parts_by_hand(
    input_views: int, rendered: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every image is rendered black, and every Gaussian lies at its pixel's centre."""

    def black(_: IDESplat, views: TrainingViews, __: Any) -> step.PhaseOutput:
        raw = torch.zeros(2, 22, 4, 4)
        return step.PhaseOutput(None, (), torch.ones(2, 1, 4, 4), raw, None, 0 * views.target_images)  # type: ignore[arg-type]

    def loss_of_target_views(output: step.PhaseOutput, views: TrainingViews, *_: Any) -> torch.Tensor:
        assert output.rendered is not None
        return step.photometric_loss(output.rendered, views.target_images, None)

    monkeypatch.setattr(step, "run_phase", black)
    monkeypatch.setattr(step, "rendering_loss", loss_of_target_views)
    arguments = (views_by_hand(), EVERYTHING, Objective.PHOTOMETRIC, None, 1, NO_TERMS, input_views)
    loss, _ = scene_loss(IDESplat(SMALL), *arguments)
    assert float(loss) == pytest.approx(1000 * photometric_by_hand(*rendered), rel=1e-5)


@pytest.mark.parametrize("input_views, rendered", ((0, (NOVEL,)), (1, (NOVEL, SECOND)), (2, (NOVEL, SECOND, FIRST))))
def test_loss_of_the_head_by_hand(
    input_views: int, rendered: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(head, "render_targets", lambda _, views: 0 * views.target_images)
    gaussians = SimpleNamespace(opacities=torch.tensor([0.25, 0.75]))
    predicted = SimpleNamespace(gaussians=gaussians, raw=torch.zeros(2, 22, 4, 4))
    model: Any = SimpleNamespace(gaussians=SimpleNamespace(predict=lambda *_: predicted))
    sample: Any = HeadSample(views_by_hand(), SimpleNamespace())  # type: ignore[arg-type]
    loss, entry = head_loss(model, sample, 1, None, input_views)
    assert float(loss) == pytest.approx(10 * photometric_by_hand(*rendered), rel=1e-5)
    assert entry["psnr"] == pytest.approx(20) and entry["opacity"] == 0.5
    squares = [value**2 for value in rendered[1:]]
    expected = -10 * math.log10(sum(squares) / len(squares)) if squares else None
    assert entry.get("input_psnr") == pytest.approx(expected)


def test_each_part_has_its_own_number_of_input_views() -> None:
    assert SETTINGS.targets == TargetViews(4, 1) and replace(SETTINGS, part="head").targets == TargetViews(4, 2)
    assert replace(SETTINGS, part="head", target_zoom=2, input_views=0).targets == TargetViews(2, 0)


@pytest.mark.parametrize("part, given, stored", ((Part.ALL, 1, None), (Part.HEAD, 2, None), (Part.HEAD, 1, 1)))
def test_the_number_of_the_part_is_no_other_setting_than_none(
    part: Part, given: int, stored: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = []
    monkeypatch.setattr(trainer, "train", lambda settings, *_, **__: used.append(settings))
    cli.train(out=tmp_path, part=part, init=tmp_path / "some.ckpt", input_views=given, target_zoom=3)
    assert used[0].input_views == stored and used[0].target_zoom == 3


@pytest.mark.parametrize(
    "changes, option", (({"target_zoom": 1}, "--target-zoom"), ({"input_views": 0}, "--input-views"))
)
def test_views_that_are_not_rendered_are_refused(changes: dict[str, Any], option: str) -> None:
    with pytest.raises(InputError, match=f"{option}: needs Gaussians"):
        network_config(replace(SETTINGS, preset="idesplat-tiny", objective="depth", **changes))


def test_checkpoints_of_earlier_versions_resume_with_the_defaults_alone(tmp_path: Path) -> None:
    state, path = TrainingState(SMALL, seed=0, lr=1e-3, vit_lr=1e-3), tmp_path / CHECKPOINT
    earlier = {name: value for name, value in asdict(SETTINGS).items() if name not in ("target_zoom", "input_views")}
    state.save(path, earlier)
    state.resume(path, asdict(SETTINGS))
    with pytest.raises(InputError, match=r"other settings \(target_zoom was 4, not 2\)"):
        state.resume(path, asdict(replace(SETTINGS, target_zoom=2)))
    with pytest.raises(InputError, match=r"other settings \(input_views was None, not 0\)"):
        state.resume(path, asdict(replace(SETTINGS, input_views=0)))
    state.start_from(path)
