"""Training of the Gaussian head alone: all before it is frozen, runs once for each scene, and is kept on disk."""

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...model.common.gaussian_adapter import SCALE_SHIFT
from ...model.common.geometry import Cameras
from ...model.idesplat.gaussian_head import HeadInputs
from ...model.idesplat.network import IDESplat
from ...runtime.system.files import atomic_write, make_folder
from ..synthetic.sampler import TRAINING_SEEDS
from .losses import Perceptual, offset_loss, render_loss
from .scenes import MAX_TARGET_ZOOM, SampleSpec, Views
from .step import PHOTOMETRIC_WEIGHT, psnr_of, render_targets, with_input_view

# The parts of the network that are trained: the focused module with what leads into it, and the head.
HEAD_PARTS = ("conv_image", "fuse", "focus", "expand", "head1", "head2", "cross_view")
HEAD_PREFIXES = tuple(f"gaussians.{part}." for part in HEAD_PARTS)
# Context views of the scenes, and the share of the scenes that have so many.
VIEW_COUNT_PROBABILITIES = {2: 0.75, 3: 0.15, 4: 0.1}
# A head whose opacities are all near 1 has no gradient left there. Its mean opacity is set to this, and its scales are
# raised by this factor, which half transparent Gaussians need to leave no gaps.
SATURATED_OPACITY, START_OPACITY = 0.95, 0.5
SCALE_GAIN = 1.1
# Head inputs that are stored in half precision, by the beginnings of their names.
HALVED = ("features", "context")
# Scenes from which the means before are taken.
RESET_SCENES = 4


@dataclass(frozen=True)
class HeadSample:
    """A scene and what the frozen part of the network makes of it."""

    views: Views
    inputs: HeadInputs


class FeatureCache:
    """Head inputs of scenes, in files that are made when they are first asked for."""

    def __init__(self, folder: Path, model: IDESplat, source: Callable[[SampleSpec], Views], description: str) -> None:
        """Use the subfolder of `folder` that belongs to the frozen weights of `model` and to the `description`.

        model: it may be trained meanwhile, but for its frozen part. source: makes a scene's views.
        description: of all that decides what `source` makes of an order.
        """
        self.model, self.source = model, source
        self.folder = make_folder(folder / _digest(model, description))

    def load(self, spec: SampleSpec) -> HeadSample:
        """The sample of an order."""
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


def cameras_of(views: Views) -> Cameras:
    """The context views' cameras."""
    return Cameras(views.extrinsics, views.intrinsics, views.near, views.far)


def head_spec(seed: int, index: int, height: int, width: int, real_ratio: float) -> SampleSpec:
    """The scene of number `index` in the set that a run with `seed` repeats; real_ratio: share of captured scenes."""
    rng = np.random.default_rng((seed, index))
    context = int(rng.choice(list(VIEW_COUNT_PROBABILITIES), p=list(VIEW_COUNT_PROBABILITIES.values())))
    scene = int(rng.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop))
    target_zooms = (1, int(rng.integers(2, MAX_TARGET_ZOOM + 1)))
    return SampleSpec(scene, context, target_zooms, height, width, real=bool(rng.random() < real_ratio))


def scene_index(seed: int, place: int, scenes: int) -> int:
    """Which of `scenes` scenes comes at a place of the run: each once an epoch, every epoch in another order."""
    epoch, rest = divmod(place, scenes)
    return int(np.random.default_rng((seed, epoch)).permutation(scenes)[rest])


def head_loss(
    model: IDESplat, sample: HeadSample, turn: int, perceptual: Perceptual | None
) -> tuple[Tensor, dict[str, float]]:
    """The loss of novel views and of one input view, each rendered from all Gaussians; and what is logged of it.

    turn: says which of the input views.
    """
    views = sample.views
    predicted = model.gaussians.predict(views.images, cameras_of(views), sample.inputs)
    shown = with_input_view(views, turn % len(views.images))
    rendered = render_targets(predicted.gaussians, shown)
    photometric = render_loss(rendered, shown.target_images, perceptual)
    loss = PHOTOMETRIC_WEIGHT * photometric + offset_loss(predicted.raw)
    novel, of_input = rendered.detach()[:-1], rendered.detach()[-1:]
    entry = {
        "loss": float(loss.detach()),
        "psnr": psnr_of(novel, shown.target_images[:-1]),
        "input_psnr": psnr_of(of_input, shown.target_images[-1:]),
        "opacity": float(predicted.gaussians.opacities.detach().mean()),
    }
    return loss, entry


@torch.no_grad()
def reset_opacity(model: IDESplat, samples: Iterable[HeadSample]) -> None:
    """Shift the head's biases so that opacity is START_OPACITY in the mean, if it is saturated, and scales fit it."""
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
    """A folder's name for the frozen weights and a description."""
    digest = hashlib.sha256(description.encode())
    for name, value in model.state_dict().items():
        if not name.startswith(HEAD_PREFIXES):
            digest.update(value.numpy().tobytes())
    return digest.hexdigest()[:16]


def _packed(sample: HeadSample) -> dict[str, Tensor]:
    """A sample as tensors by name, images as bytes and features in half precision."""
    views = {field.name: getattr(sample.views, field.name) for field in fields(Views)}
    for name in ("images", "target_images"):
        views[name] = (views[name] * 255).round().to(torch.uint8)
    del views["inverse_depth"]  # the truth, which the head's losses do not use
    inputs = sample.inputs._asdict()
    return {**views, **{name: value.half() if name.startswith(HALVED) else value for name, value in inputs.items()}}


def _unhalved(value: Tensor) -> Tensor:
    return value.float() if value.dtype == torch.float16 else value


def _unpacked(packed: dict[str, Tensor]) -> HeadSample:
    inputs = HeadInputs(**{name: _unhalved(packed.pop(name)) for name in HeadInputs._fields})
    for name in ("images", "target_images"):
        packed[name] = packed[name].float() / 255
    return HeadSample(Views(**packed, inverse_depth=None), inputs)
