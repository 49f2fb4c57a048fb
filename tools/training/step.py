"""One scene through the parts of the network that a phase trains: predictions, losses and measures."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ...model.common.geometry import invert_rigid, scale_intrinsics
from ...model.common.layers import resize
from ...model.idesplat.dpbu import Cameras, DPBUOutput
from ...model.idesplat.encoder import EncoderFeatures
from ...model.idesplat.network import IDESplat
from .losses import (
    Perceptual,
    candidate_spacing,
    dpbu_loss,
    inverse_depth_loss,
    monocular_loss,
    offset_loss,
    render_loss,
)
from .rasterizer import rasterize
from .scenes import Views
from .schedule import Objective, Phase

# Squared errors of colours are small beside errors of depth counted in candidates.
PHOTOMETRIC_WEIGHT = 10.0
WITHIN = 0.05


@dataclass(frozen=True)
class PhaseOutput:
    """What the parts that ran say of a scene."""

    encoded: EncoderFeatures
    units: tuple[DPBUOutput, ...]
    # The best inverse depth there is, [views, 1, h, w]; h and w are the images' once three units ran.
    inverse_depth: Tensor
    # Where the phase has Gaussians: their raw parameters [views, parameters, H, W], and novel views [targets, 3, H, W].
    raw: Tensor | None = None
    rendered: Tensor | None = None


def run_phase(model: IDESplat, views: Views, phase: Phase) -> PhaseOutput:
    """Run the encoder and as many units as the phase has; with three also the depth fusion and, if asked, all else."""
    cameras = Cameras(views.extrinsics, views.intrinsics, views.near, views.far)
    encoded = model.encoder(views.images, views.extrinsics)
    first = model.dpbu1(encoded, cameras)
    if phase.units == 1:
        return PhaseOutput(encoded, (first,), first.inverse_depth)
    second = model.dpbu2(encoded, first, cameras)
    if phase.units == 2:
        return PhaseOutput(encoded, (first, second), second.inverse_depth)
    units = (first, second, model.dpbu3(encoded, second, cameras))
    if not phase.gaussians:
        fused = model.gaussians.fused_inverse_depth(units, cameras, *views.images.shape[2:])
        return PhaseOutput(encoded, units, fused)
    predicted = model.gaussians(views.images, cameras, encoded, units)
    rendered = render_targets(predicted.gaussians, views)
    return PhaseOutput(encoded, units, 1 / predicted.depth[:, None], predicted.raw, rendered)


def render_targets(gaussians: tuple[Tensor, ...], views: Views) -> Tensor:
    """The Gaussians (means, scales, quats, opacities, sh) from the target cameras, on black, [targets, 3, H, W]."""
    means, scales, quats, opacities, sh = gaussians
    height, width = views.target_images.shape[2:]
    pixels = scale_intrinsics(views.target_intrinsics, height, width)
    background = torch.zeros(3)
    images = [
        rasterize(means, quats, scales, opacities, sh, viewmat, K, width, height, background)[0]
        for viewmat, K in zip(invert_rigid(views.target_extrinsics), pixels, strict=True)
    ]
    return torch.stack(images).permute(0, 3, 1, 2)


def with_input_view(views: Views, index: int) -> Views:
    """The same views, whose targets are followed by one of the context views."""
    return replace(
        views,
        target_images=torch.cat([views.target_images, views.images[index : index + 1]]),
        target_extrinsics=torch.cat([views.target_extrinsics, views.extrinsics[index : index + 1]]),
        target_intrinsics=torch.cat([views.target_intrinsics, views.intrinsics[index : index + 1]]),
    )


@contextmanager
def matching_scores(model: IDESplat) -> Iterator[list[Tensor]]:
    """Collect what each epipolar layer hands to its regulariser, two layers a unit, [pairs, candidates, h, w] each."""
    scores: list[Tensor] = []

    def collect(_: nn.Module, inputs: tuple[Tensor, int]) -> None:
        scores.append(inputs[0][:, 1:])  # the first channel is the seed

    layers = [layer for unit in (model.dpbu1, model.dpbu2, model.dpbu3) for layer in (unit.first, unit.second)]
    handles = [layer.regulariser.register_forward_pre_hook(collect) for layer in layers]
    try:
        yield scores
    finally:
        for handle in handles:
            handle.remove()


def scene_loss(
    model: IDESplat, views: Views, phase: Phase, objective: Objective, perceptual: Perceptual | None, turn: int = 0
) -> tuple[Tensor, dict[str, float]]:
    """The loss of a scene, and what is logged of it.

    Where novel views are rendered, an input view is, too, from the Gaussians of all views; turn: says which.
    """
    if phase.gaussians:
        views = with_input_view(views, turn % len(views.images))
    with matching_scores(model) as scores:
        outcome = run_phase(model, views, phase)
    loss = torch.zeros(())
    entry = measures(outcome, views)
    if objective is not Objective.PHOTOMETRIC and views.inverse_depth is not None:
        bins = candidate_spacing(model.config, views.near, views.far)
        loss = loss + monocular_loss(outcome.encoded, views.inverse_depth)
        for index, unit in enumerate(outcome.units):
            of_layers = scores[2 * index], scores[2 * index + 1]
            loss = loss + dpbu_loss(unit, of_layers, views.inverse_depth, bins)
        if phase.units == 3:
            loss = loss + inverse_depth_loss(outcome.inverse_depth, views.inverse_depth[:, None], bins)
    if outcome.raw is not None:
        loss = loss + offset_loss(outcome.raw)
    if outcome.rendered is not None:
        loss = loss + PHOTOMETRIC_WEIGHT * render_loss(outcome.rendered, views.target_images, perceptual)
    return loss, {"loss": float(loss.detach()), **entry}


@torch.no_grad()
def measures(outcome: PhaseOutput, views: Views) -> dict[str, float]:
    """AbsRel (mean of |D / D* - 1|) and the share of pixels within 5 % at the size of the images; PSNR of novel views.

    Pixels that only one view sees are counted too. Photographs have no true depth.
    """
    entry = {}
    if views.inverse_depth is not None:
        inverse_depth = resize(outcome.inverse_depth, *views.images.shape[2:])[:, 0]
        error = (views.inverse_depth / inverse_depth - 1).abs()
        entry = {"abs_rel": float(error.mean()), "within": float((error < WITHIN).float().mean())}
    if outcome.rendered is not None:
        entry["psnr"] = psnr_of(outcome.rendered, views.target_images)
    return entry


def psnr_of(rendered: Tensor, truth: Tensor) -> float:
    """PSNR in dB over all of some images, [views, 3, H, W]."""
    return float(-10 * (rendered - truth).square().mean().log10())
