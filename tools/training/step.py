"""Scenes through the network as far as a phase trains it: predictions, loss and metrics."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ...model.common.gaussian_adapter import WorldGaussians
from ...model.common.geometry import denormalize_intrinsics, invert_rigid
from ...model.common.layers import resize
from ...model.idesplat.dpbu import Cameras, DPBUOutput
from ...model.idesplat.encoder import EncoderFeatures
from ...model.idesplat.network import IDESplat
from ..perceptual import Perceptual
from .data.samples import TrainingViews
from .losses import candidate_spacing, dpbu_loss, inverse_depth_loss, monocular_loss, offset_prior, photometric_loss
from .objectives.consistency import consistency_loss
from .objectives.defocus import defocus_loss
from .objectives.pointmap import exact_pointmap, pointmap_loss
from .options import INPUT_VIEWS, NO_TERMS, Objective, OptionalTerms, Part
from .rasterizer import render_images
from .scene_batches import separate_scenes
from .schedule import Phase

# Weight of the photometric loss beside the offset prior.
PHOTOMETRIC_WEIGHT = 10.0
# Weight of both beside the depth losses, which are errors in candidate spacings. Without it the gradients that reach
# the DPBUs from rendered views are a thousandth of those from depth; with it, some tenth.
RENDERING_WEIGHT = 100.0
# Weight of the defocus loss, an L1 error, beside the squared error.
DEFOCUS_WEIGHT = 0.1
# The metric `within` is the share of pixels whose depth has a smaller relative error.
WITHIN = 0.05


@dataclass(frozen=True)
class PhaseOutput:
    """The predictions of the parts that a phase runs.

    inverse_depth: the finest one, [views, 1, h, w]; of the images' size if all three DPBUs ran. raw, gaussians,
    rendered: where the phase has Gaussians, their raw parameters [views, parameters, H, W], the Gaussians in the order
    of views and pixels, and target views [targets, 3, H, W].
    """

    encoded: EncoderFeatures
    dpbus: tuple[DPBUOutput, ...]
    inverse_depth: Tensor
    raw: Tensor | None = None
    gaussians: WorldGaussians | None = None
    rendered: Tensor | None = None


def run_phase(model: IDESplat, views: TrainingViews, phase: Phase) -> PhaseOutput:
    """Run the encoder and the phase's DPBUs; with all three also depth fusion or, if the phase has it, the head."""
    cameras = Cameras(views.extrinsics, views.intrinsics, views.near, views.far)
    encoded = model.encoder(views.images, views.extrinsics)
    first = model.dpbu1(encoded, cameras)
    if phase.dpbus == 1:
        return PhaseOutput(encoded, (first,), first.inverse_depth)
    second = model.dpbu2(encoded, first, cameras)
    if phase.dpbus == 2:
        return PhaseOutput(encoded, (first, second), second.inverse_depth)
    outputs = (first, second, model.dpbu3(encoded, second, cameras))
    if not phase.gaussians:
        fused = model.gaussians.fused_inverse_depth(outputs, cameras, *views.images.shape[2:])
        return PhaseOutput(encoded, outputs, fused)
    predicted = model.gaussians(views.images, cameras, encoded, outputs)
    rendered = render_targets(predicted.gaussians, views)
    return PhaseOutput(encoded, outputs, 1 / predicted.depth[:, None], predicted.raw, predicted.gaussians, rendered)


def render_targets(gaussians: tuple[Tensor, ...], views: TrainingViews) -> Tensor:
    """Gaussians (means, scales, quats, opacities, sh) seen by the target cameras, on black, [targets, 3, H, W].

    Those of several scenes follow each other, as their target cameras do.
    """
    height, width = views.target_images.shape[2:]
    Ks = denormalize_intrinsics(views.target_intrinsics, width, height)
    viewmats = invert_rigid(views.target_extrinsics)
    scenes = list(zip(*(part.chunk(views.scenes) for part in gaussians), strict=True))
    targets = len(viewmats) // views.scenes
    of_images = [scene for scene in scenes for _ in range(targets)]
    return render_images(of_images, viewmats, Ks, width, height).permute(0, 3, 1, 2)


def with_input_views(views: TrainingViews, first: int, count: int = 1) -> TrainingViews:
    """The same views, with `count` of each scene's context views as further targets: from `first` on, in a circle.

    A scene with fewer context views gets each of them once.
    """
    context = len(views.images) // views.scenes
    chosen = [(first + place) % context for place in range(min(count, context))]

    def appended(targets: Tensor, inputs: Tensor) -> Tensor:
        targets, inputs = (part.unflatten(0, (views.scenes, -1)) for part in (targets, inputs))
        return torch.cat([targets, inputs[:, chosen]], dim=1).flatten(0, 1)

    return replace(
        views,
        target_images=appended(views.target_images, views.images),
        target_extrinsics=appended(views.target_extrinsics, views.extrinsics),
        target_intrinsics=appended(views.target_intrinsics, views.intrinsics),
    )


@contextmanager
def record_correlations(model: IDESplat) -> Iterator[list[Tensor]]:
    """Record the correlations [pairs, candidates, h, w] that each epipolar layer gives its U-Net, two layers a DPBU."""
    correlations: list[Tensor] = []

    def record(_: nn.Module, inputs: tuple[Tensor, int]) -> None:
        correlations.append(inputs[0][:, 1:])  # the first channel is the coarse inverse depth

    layers = [layer for dpbu in (model.dpbu1, model.dpbu2, model.dpbu3) for layer in (dpbu.first, dpbu.second)]
    handles = [layer.regulariser.register_forward_pre_hook(record) for layer in layers]
    try:
        yield correlations
    finally:
        for handle in handles:
            handle.remove()


def scene_loss(
    model: IDESplat,
    views: TrainingViews,
    phase: Phase,
    objective: Objective,
    perceptual: Perceptual | None,
    step: int = 0,
    terms: OptionalTerms = NO_TERMS,
    input_views: int = INPUT_VIEWS[Part.ALL],
) -> tuple[Tensor, dict[str, float]]:
    """The loss of a scene, or the mean loss of several, and what is logged.

    If target views are rendered, so many context views are rendered, too, from the Gaussians of all views: from number
    `step` modulo their count on.
    """
    if phase.gaussians:
        views = with_input_views(views, step, input_views)
    with record_correlations(model) as correlations, separate_scenes(model, views.scenes):
        output = run_phase(model, views, phase)
    loss = torch.zeros((), device=views.images.device)
    entry = scene_metrics(output, views)
    if objective is not Objective.PHOTOMETRIC and views.inverse_depth is not None:
        spacing = candidate_spacing(model.config, views.near, views.far)
        loss = loss + monocular_loss(output.encoded, views.inverse_depth, views.scenes)
        for index, dpbu in enumerate(output.dpbus):
            scores = correlations[2 * index], correlations[2 * index + 1]
            loss = loss + dpbu_loss(dpbu, scores, views.inverse_depth, spacing, views.scenes)
        if phase.dpbus == 3:
            loss = loss + inverse_depth_loss(output.inverse_depth, views.inverse_depth[:, None], spacing)
    if output.raw is not None and output.rendered is not None:
        rendering = rendering_loss(output, views, perceptual, terms)
        loss = loss + RENDERING_WEIGHT * (PHOTOMETRIC_WEIGHT * rendering + offset_prior(output.raw))
    return loss, {"loss": float(loss.detach()), **entry}


def rendering_loss(
    output: PhaseOutput, views: TrainingViews, perceptual: Perceptual | None, terms: OptionalTerms
) -> Tensor:
    """The photometric loss of the target views, and the terms that are asked for.

    With a lens, the defocus loss takes the place of the photometric loss of captures. PM-Loss compares synthetic scenes
    with their exact points, and captures with their pointmap, where they have one.
    """
    assert output.gaussians is not None and output.rendered is not None
    if terms.aperture and views.inverse_depth is None:
        loss = DEFOCUS_WEIGHT * defocus_loss(output.gaussians, views, terms.aperture)
    else:
        loss = photometric_loss(output.rendered, views.target_images, perceptual)
    if terms.pm_loss:
        pointmap = views.pointmap if views.inverse_depth is None else exact_pointmap(views)
        if pointmap is not None:
            loss = loss + terms.pm_loss * pointmap_loss(output.gaussians.means, pointmap)
    if terms.consistency:
        loss = loss + terms.consistency * consistency_loss(1 / output.inverse_depth[:, 0], views)
    return loss


@torch.no_grad()
def scene_metrics(output: PhaseOutput, views: TrainingViews) -> dict[str, float]:
    """Depth: `abs_rel`, the mean of |D / D* - 1|, and `within`; rendered views: `psnr`, the mean of scenes.

    All pixels of the context views count, at the images' size, even those that one view alone sees. Captures have no
    true depth.
    """
    entry = {}
    if views.inverse_depth is not None:
        inverse_depth = resize(output.inverse_depth, *views.images.shape[2:])[:, 0]
        error = (views.inverse_depth / inverse_depth - 1).abs()
        entry = {"abs_rel": float(error.mean()), "within": float((error < WITHIN).float().mean())}
    if output.rendered is not None:
        scenes = zip(output.rendered.chunk(views.scenes), views.target_images.chunk(views.scenes), strict=True)
        entry["psnr"] = sum(psnr(rendered, truth) for rendered, truth in scenes) / views.scenes
    return entry


def psnr(rendered: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB over all pixels of the images [views, 3, H, W], in [0, 1]."""
    return float(-10 * (rendered - truth).square().mean().log10())
