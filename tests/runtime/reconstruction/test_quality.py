"""The option --refine, and the plan that a quality makes."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from idesplat import InputError
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.reconstruction.quality import (
    MAX_STEPS,
    PRESETS,
    SECONDS_PER_FURTHER_VIEW,
    Quality,
    RefinementLimit,
    parse_refine,
)
from idesplat.runtime.reconstruction.steps import make_plan
from idesplat.runtime.splats.filtering import FilterOptions


@pytest.mark.parametrize(
    ("text", "limit"),
    [("0", RefinementLimit(0)), ("120", RefinementLimit(120)), ("30s", RefinementLimit(MAX_STEPS, 30.0))],
)
def test_refine_is_steps_or_seconds(text: str, limit: RefinementLimit) -> None:
    assert parse_refine(text) == limit


@pytest.mark.parametrize("text", ["", "s", "-1", "1.5", "0s", "30 s", "30m", "1000000", "100001", "٣"])
def test_everything_else_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--refine"):
        parse_refine(text)


def plan(quality: str | None = None, refine: str | None = None, bundled: bool = True, **options):
    path = bundled_model() if bundled else Path("own.onnx")
    model = SimpleNamespace(path=path, metadata=SimpleNamespace(gaussians=options.pop("gaussians", True)))
    return make_plan(quality, model, refine, FilterOptions(), options.pop("max_gaussians", 0))


def test_the_bundled_model_is_refined_by_default_and_others_are_left_as_they_predict() -> None:
    assert plan().preset is PRESETS[Quality.STANDARD] and plan().copy_side > 0
    own = plan(bundled=False)
    assert own.preset is PRESETS[Quality.FAST] and own.copy_side == 0 and not own.filters.enabled
    assert plan("high", bundled=False).filters.remove_contradicted


def test_more_copies_are_kept_and_less_is_removed_without_refinement() -> None:
    refined, unrefined = plan("standard").filters, plan("standard", "0").filters
    assert (refined.remove_redundant, unrefined.remove_redundant) == (2, 6)
    assert refined.remove_contradicted > unrefined.remove_contradicted > 0


def test_refine_overrides_the_quality() -> None:
    assert plan("standard", "0").copy_side == 0
    assert plan("fast", "40").refinement(2).steps == 40
    for quality in ("fast", "high"):
        timed = plan(quality, "25s").refinement(6)
        assert timed.seconds == 25 and timed.steps == MAX_STEPS
    per_added_view = PRESETS[Quality.STANDARD].steps_per_added_view
    for views in (2, 6):
        assert plan("standard").refinement(views).steps == (views - 1) * per_added_view


def test_more_images_than_the_quality_takes_have_more_time() -> None:
    standard = PRESETS[Quality.STANDARD]
    assert plan("standard").refinement(2).seconds == plan("standard").refinement(standard.views).seconds
    further = 12
    more = plan("standard").refinement(standard.views + further).seconds
    assert more == standard.seconds + further * SECONDS_PER_FURTHER_VIEW


def test_a_limit_on_the_gaussians_alone_changes_none_of_those_that_stay() -> None:
    options = plan("fast", max_gaussians=10).refinement(6)
    assert (options.steps, options.max_gaussians, options.max_opacity, options.scale_factor) == (0, 10, 1, 1)
    assert plan("fast", max_gaussians=10).copy_side > 0


def test_a_model_of_depth_alone_is_neither_fused_nor_refined() -> None:
    depth_only = plan("standard", gaussians=False)
    assert depth_only.copy_side == 0 and not depth_only.filters.enabled


@pytest.mark.parametrize("options", [{"quality": "best"}, {"max_gaussians": -1}])
def test_values_that_do_not_exist_are_refused(options: dict) -> None:
    with pytest.raises(InputError, match="expected"):
        plan(**options)
