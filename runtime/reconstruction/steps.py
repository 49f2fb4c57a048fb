"""The steps of a reconstruction after the prediction: fusion of the views, and refinement on their images."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from ..errors import InputError
from ..inference.model_files import ModelFiles
from ..inference.predictor import Prediction
from ..refinement.colors import fit_colors
from ..refinement.options import RefinementOptions, prediction_options
from ..refinement.refine import refine
from ..refinement.views import posed_image, posed_images
from ..splats.filtering import FilterOptions, describe_removed, filter_gaussians
from ..splats.free_space import find_in_free_space
from ..splats.fusion import MIN_VOTING_VIEWS
from ..splats.gaussians import Gaussians
from ..views.batch import ViewBatch
from ..views.depth_range import DepthRange
from ..views.exposure import Exposure
from .bounds import check_max_gaussians
from .many_views import voting_views
from .quality import PRESETS, Preset, Quality, RefinementLimit, default_quality, parse_refine
from .stereo import correct_depths

# What fusion removes. Refinement takes less time with two copies of a surface, and gives better views. Without it, each
# view is best shown by its own Gaussians, and a wrong one before a surface of its own colour is better than a hole.
REFINED: dict[str, Any] = {"remove_contradicted": 1.0, "remove_redundant": 2}
UNREFINED: dict[str, Any] = {"remove_contradicted": 0.25, "remove_redundant": 6}


@dataclass(frozen=True)
class Plan:
    """What happens to a prediction: the quality's preset, the filters, and the limits of the refinement.

    limit: None for the preset's. max_gaussians: to keep; 0 for all. gaussians: whether the model predicts any.
    """

    preset: Preset
    filters: FilterOptions
    limit: RefinementLimit | None
    max_gaussians: int
    gaussians: bool

    @property
    def refines(self) -> bool:
        """Whether the refinement has any steps."""
        return bool(self.limit.steps if self.limit else self.preset.steps_per_added_view)

    @property
    def copy_side(self) -> int:
        """The longer side of the images to refine on; 0 where there is nothing to do."""
        return self.preset.copy_side if self.gaussians and (self.refines or self.max_gaussians) else 0

    @property
    def fuses(self) -> bool:
        """Whether depths are made to suit all views, and what these do not confirm is removed."""
        return self.preset.fuse and self.gaussians

    def refinement(self, views: int) -> RefinementOptions:
        """The options of the refinement on so many views."""
        limit = self.limit or self.preset.limit(views)
        return prediction_options(limit.steps, seconds=limit.seconds, max_gaussians=self.max_gaussians)


@dataclass(frozen=True)
class Stepped:
    """A prediction after a step, with what the step has to say.

    psnr: of the refinement's views before each step. exposure: from the views that were refined on to the scene; None
    without refinement.
    """

    prediction: Prediction
    removed: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    exposure: Exposure | None = None


def make_plan(
    quality: Quality | str | None, model: ModelFiles, refine: str | None, filters: FilterOptions, max_gaussians: int
) -> Plan:
    """The plan for a quality, by default that of `default_quality`.

    Raises InputError for a quality or a refinement that is none.
    """
    if quality is not None and quality not in list(Quality):
        raise InputError(f"--quality {quality}: expected one of {', '.join(Quality)}")
    check_max_gaussians(max_gaussians)
    preset = PRESETS[Quality(quality or default_quality(model.path))]
    limit = parse_refine(refine) if refine is not None else None
    plan = Plan(preset, filters, limit, max_gaussians, model.metadata.gaussians)
    if not plan.fuses:
        return plan
    removed = REFINED if plan.refines else UNREFINED
    return replace(plan, filters=replace(filters, **removed, close_holes=True))


def fuse(prediction: Prediction, views: ViewBatch, span: DepthRange, plan: Plan) -> Stepped:
    """The Gaussians that the plan's filters keep; if it fuses views, with depths that suit all of them.

    If no refinement follows, which would fit the colours, they are fitted to the views' images.
    """
    if not (plan.fuses or plan.filters.enabled):
        return Stepped(prediction)
    started = time.perf_counter()
    voters = voting_views(views, span)
    if plan.fuses:
        prediction = correct_depths(prediction, views, voters)
    kept, removed = filter_gaussians(
        prediction.need_gaussians(),
        prediction.depth,
        views.extrinsics,
        views.intrinsics,
        plan.filters,
        voters,
        views.images,
    )
    cleared = _clear_free_space(kept, prediction, views, plan)
    if cleared is not kept:
        kept, removed = cleared, removed | {"free_space": len(kept) - len(cleared)}
    if plan.fuses and not plan.refines:
        kept = fit_colors(kept, posed_images(views))
    notes = [describe_removed(removed, len(kept))] if any(removed.values()) else []
    return Stepped(replace(prediction, gaussians=kept), removed, {"fuse": time.perf_counter() - started}, notes)


def refine_prediction(
    prediction: Prediction, views: ViewBatch, plan: Plan, on_step: Callable[[int, float], bool] | None
) -> Stepped:
    """The prediction with its Gaussians fitted to the views' images, if these were kept for it."""
    if not views.copies:
        return Stepped(prediction)
    started = time.perf_counter()
    images = [posed_image(copy, pose) for copy, pose in zip(views.copies, views.extrinsics, strict=True)]
    refined = refine(prediction.need_gaussians(), images, plan.refinement(len(images)), on_step)
    gaussians = _clear_free_space(refined.gaussians, prediction, views, plan)  # refinement moves some there
    seconds = time.perf_counter() - started
    notes = []
    if refined.steps:
        first, last = refined.mean_psnr()
        notes.append(
            f"refined in {refined.steps} steps, {seconds:.0f} s: PSNR of the input views {first:.1f} to {last:.1f} dB"
        )
    exposure = Exposure(1 / refined.gains, -refined.offsets / refined.gains)
    return Stepped(replace(prediction, gaussians=gaussians), {}, {"refine": seconds}, notes, refined.psnr, exposure)


def _clear_free_space(gaussians: Gaussians, prediction: Prediction, views: ViewBatch, plan: Plan) -> Gaussians:
    """Those that do not hang right before the cameras, if the plan fuses views; all, if that would leave none."""
    if not plan.fuses or len(views.names) < MIN_VOTING_VIEWS:
        return gaussians
    found = find_in_free_space(gaussians.means, prediction.depth, views.extrinsics, views.intrinsics)
    return gaussians if found.all() else gaussians.select(~found)
