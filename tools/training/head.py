"""Training of the Gaussian head alone: the frozen part runs once per scene, and its output is cached on disk."""

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...model.common.gaussian_adapter import SCALE_SHIFT
from ...model.common.geometry import Cameras
from ...model.idesplat.gaussian_head import HeadInputs
from ...model.idesplat.network import IDESplat
from ...runtime.system.files import atomic_write, make_folder
from ..perceptual import Perceptual
from ..synthetic.sampler import TRAINING_SEEDS
from .data.samples import SampleSpec, TrainingViews
from .data.synthetic import sample_target_zooms, sample_view_count
from .losses import offset_prior, photometric_loss
from .options import INPUT_VIEWS, TARGET_ZOOM, Part
from .step import PHOTOMETRIC_WEIGHT, psnr, render_targets, with_input_views

# The trained parts of the network: the Gaussian focused module with its input convolutions, and the head.
HEAD_PARTS = ("conv_image", "fuse", "focus", "expand", "head1", "head2", "cross_view")
HEAD_PREFIXES = tuple(f"gaussians.{part}." for part in HEAD_PARTS)
# Numbers of context views, and their probabilities.
VIEW_COUNT_PROBABILITIES = {2: 0.75, 3: 0.12, 4: 0.08, 6: 0.05}
# If the mean opacity is above the first value, the sigmoid is saturated and has no gradient. The mean is then reset to
# the second value, and scales are multiplied by SCALE_GAIN, so that the more transparent Gaussians leave no gaps.
SATURATED_OPACITY, START_OPACITY = 0.95, 0.5
SCALE_GAIN = 1.1
# Prefixes of the head's inputs that are stored in half precision.
HALVED = ("features", "context")
# Number of scenes over which opacities are averaged.
RESET_SCENES = 4
# Parts of a sample that the loss of the head does not use.
UNUSED = ("inverse_depth", "pointmap", "scenes", "matches")


@dataclass(frozen=True)
class HeadSample:
    """The views of a scene, and the head's inputs that the frozen part of the network computes from them."""

    views: TrainingViews
    inputs: HeadInputs


class FeatureCache:
    """The head's inputs of scenes, in files that are written on first use."""

    def __init__(
        self, folder: Path, model: IDESplat, source: Callable[[SampleSpec], TrainingViews], description: str
    ) -> None:
        """Use the subfolder of `folder` that belongs to the frozen weights of `model` and to the `description`.

        model: its head may change meanwhile. source: gives the views of a sample.
        description: all settings on which `source` depends.
        """
        self.model, self.source = model, source
        self.folder = make_folder(folder / _digest(model, description))

    def load(self, spec: SampleSpec) -> HeadSample:
        """The sample of a specification."""
        torch.set_flush_denormal(True)  # a setting of each thread
        path = self.folder / f"{spec.seed}-{spec.context}-{'real' if spec.real else 'synthetic'}.pt"
        if not path.exists():
            with atomic_write(path) as temporary:
                torch.save(_packed(self._compute(spec)), temporary)
        return _unpacked(torch.load(path, weights_only=True))

    @torch.no_grad()
    def _compute(self, spec: SampleSpec) -> HeadSample:
        views, model = self.source(spec), self.model
        cameras = cameras_of(views)
        encoded = model.encoder(views.images, views.extrinsics)
        first = model.dpbu1(encoded, cameras)
        second = model.dpbu2(encoded, first, cameras)
        third = model.dpbu3(encoded, second, cameras)
        return HeadSample(views, model.gaussians.head_inputs(views.images, cameras, encoded, (first, second, third)))


def cameras_of(views: TrainingViews) -> Cameras:
    """The context views' cameras."""
    return Cameras(views.extrinsics, views.intrinsics, views.near, views.far)


def head_spec(
    seed: int, index: int, height: int, width: int, real_ratio: float, target_zoom: int = TARGET_ZOOM
) -> SampleSpec:
    """Scene number `index` of the set that a run with `seed` repeats.

    real_ratio: probability of a capture. target_zoom: the largest zoom of a target view.
    """
    rng = np.random.default_rng((seed, index))
    context = sample_view_count(rng, VIEW_COUNT_PROBABILITIES)
    scene = int(rng.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop))
    target_zooms = sample_target_zooms(rng, target_zoom)
    return SampleSpec(scene, context, target_zooms, height, width, real=bool(rng.random() < real_ratio))


def scene_index(seed: int, place: int, scenes: int) -> int:
    """The scene at a place of the run: each of `scenes` once per epoch, in an order that differs between epochs."""
    epoch, rest = divmod(place, scenes)
    return int(np.random.default_rng((seed, epoch)).permutation(scenes)[rest])


def head_loss(
    model: IDESplat,
    sample: HeadSample,
    step: int,
    perceptual: Perceptual | None,
    input_views: int = INPUT_VIEWS[Part.HEAD],
) -> tuple[Tensor, dict[str, float]]:
    """The loss of a sample, and what is logged.

    Target views and so many context views are rendered, from number `step` modulo their count on.
    """
    views = sample.views
    predicted = model.gaussians.predict(views.images, cameras_of(views), sample.inputs)
    shown = with_input_views(views, step, input_views)
    rendered = render_targets(predicted.gaussians, shown)
    photometric = photometric_loss(rendered, shown.target_images, perceptual)
    loss = PHOTOMETRIC_WEIGHT * photometric + offset_prior(predicted.raw)
    novel = len(views.target_images)
    entry = {
        "loss": float(loss.detach()),
        "psnr": psnr(rendered[:novel].detach(), views.target_images),
        "opacity": float(predicted.gaussians.opacities.detach().mean()),
    }
    if input_views:
        entry["input_psnr"] = psnr(rendered[novel:].detach(), shown.target_images[novel:])
    return loss, entry


@torch.no_grad()
def reset_opacity(model: IDESplat, samples: Iterable[HeadSample]) -> None:
    """If opacities are saturated, shift the head's biases so that their mean is START_OPACITY, and scales grow."""
    parameters = []
    for sample in samples:
        raw = model.gaussians.predict(sample.views.images, cameras_of(sample.views), sample.inputs).raw
        parameters.append(raw.transpose(0, 1).flatten(1))
    raw = torch.cat(parameters, dim=1)  # [parameters, pixels]
    if raw[0].sigmoid().mean() < SATURATED_OPACITY:
        return
    bias = model.gaussians.head2.bias
    assert bias is not None
    bias[0] += math.log(START_OPACITY / (1 - START_OPACITY)) - raw[0].mean()
    if model.config.scale_in_pixels:
        scale = F.softplus(raw[3:6].median() - SCALE_SHIFT)
        bias[3:6] += (SCALE_GAIN * scale).expm1().log() - scale.expm1().log()


def _digest(model: IDESplat, description: str) -> str:
    """A folder name that identifies the frozen weights and a description."""
    digest = hashlib.sha256(description.encode())
    for name, value in model.state_dict().items():
        if not name.startswith(HEAD_PREFIXES):
            digest.update(value.numpy().tobytes())
    return digest.hexdigest()[:16]


def _packed(sample: HeadSample) -> dict[str, Tensor]:
    """A sample as tensors by name: images as uint8, features in half precision."""
    views = {field.name: getattr(sample.views, field.name) for field in fields(TrainingViews)}
    for name in ("images", "target_images"):
        views[name] = (views[name] * 255).round().to(torch.uint8)
    for name in UNUSED:
        del views[name]
    inputs = sample.inputs._asdict()
    return {**views, **{name: value.half() if name.startswith(HALVED) else value for name, value in inputs.items()}}


def _unhalved(value: Tensor) -> Tensor:
    return value.float() if value.dtype == torch.float16 else value


def _unpacked(packed: dict[str, Any]) -> HeadSample:
    inputs = HeadInputs(**{name: _unhalved(packed.pop(name)) for name in HeadInputs._fields})
    for name in ("images", "target_images"):
        packed[name] = packed[name].float() / 255
    return HeadSample(TrainingViews(**packed, inverse_depth=None), inputs)
