"""Validation on real captures: held-out images of the validation captures, rendered from what the network predicts.

The captures and their loading are those of `idesplat eval captures`. The network runs in PyTorch on two views; nothing
refines its Gaussians or closes holes. Each capture gives its first triple, so that a validation takes little time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.network import IDESplat
from ...runtime.errors import InputError
from ...runtime.inference.normalization import SceneNormalization
from ...runtime.views.batch import ViewBatch
from ...runtime.views.depth_range import DepthRange, estimate_depth_range
from ..evaluation.captures.capture import Capture, CaptureImages, read_captures
from ..evaluation.captures.checkouts import find_checkout, frames_of
from ..evaluation.cases import EvalCase
from .data.samples import TrainingViews
from .settings import TrainingSettings
from .step import psnr, render_targets


@dataclass(frozen=True)
class CaptureCase:
    """Two context views and a held-out target of a capture in the network's units; valid: bool [height, width]."""

    views: TrainingViews
    valid: Tensor


class CaptureValidation:
    """The held-out images of the validation captures in a folder of checkouts, at the size of a run."""

    def __init__(self, checkouts: Path, settings: TrainingSettings, config: IDESplatConfig) -> None:
        """Load the images. checkouts: as of `idesplat eval captures`; captures that are not there are left out.

        Raises InputError if none is there, if the run trains on one of them, and for images that cannot be read.
        """
        found = find_captures(checkouts)
        check_not_trained_on(settings, [checkouts, *found.values()])
        self.cases = [_load(checkouts, capture, settings.size, config) for capture in found]

    @torch.no_grad()
    def mean_psnr(self, model: IDESplat) -> float:
        """The mean PSNR in dB of the held-out images, rendered from what the network predicts from two views."""
        device = next(model.parameters()).device
        return sum(_psnr(model, case, device) for case in self.cases) / len(self.cases)


def find_captures(checkouts: Path) -> dict[Capture, Path]:
    """The validation captures whose repositories are in a folder, with their checkouts; raises InputError if none."""
    captures = read_captures()
    checkout_of = {capture: find_checkout(checkouts, capture.repository) for capture in captures}
    found = {capture: checkout for capture, checkout in checkout_of.items() if checkout is not None}
    if not found:
        example = captures[0].repository.replace("/", "+")
        raise InputError(
            f"--validate-captures {checkouts}: contains no validation capture; expected checkouts, such as {example}, "
            "as idesplat eval captures --checkouts makes them"
        )
    return found


def check_not_trained_on(settings: TrainingSettings, held_out: Sequence[Path]) -> None:
    """Raise InputError if the run trains on images in one of the folders `held_out`."""
    roots = [folder.resolve() for folder in held_out]
    given = [("--data", folder) for folder in settings.data]
    if settings.textures:
        given.append(("--textures", settings.textures))
    for option, folder in given:
        if any(Path(folder).resolve().is_relative_to(root) for root in roots):
            raise InputError(
                f"{option} {folder}: is a folder of the validation captures, which are never trained on; leave it out"
            )


def to_views(case: EvalCase, trained_near: float) -> TrainingViews:
    """An evaluation case in the frame and unit of training, in which near is `trained_near`, as in inference."""
    context, targets = case.context, case.targets
    scene = SceneNormalization.of(context.extrinsics, np.array([case.near]), trained_near)
    near, far = (torch.full((len(context),), depth * scene.scale) for depth in (case.near, case.far))
    return TrainingViews(
        torch.from_numpy(context.images),
        torch.from_numpy(scene.apply(context.extrinsics)),
        torch.from_numpy(context.intrinsics).float(),
        near,
        far,
        None,
        torch.from_numpy(targets.images),
        torch.from_numpy(scene.apply(targets.extrinsics)),
        torch.from_numpy(targets.intrinsics).float(),
    )


def _load(checkouts: Path, capture: Capture, side: int, config: IDESplatConfig) -> CaptureCase:
    """The first triple of a capture, square. checkouts: the folder of checkouts."""
    triple = capture.triples[0]
    used = (*triple.context, triple.target)
    of_triple = replace(capture, cameras={name: capture.cameras[name] for name in used})  # so that no more is extracted

    def find_range(views: ViewBatch) -> DepthRange:
        poses = views.extrinsics, views.intrinsics
        return estimate_depth_range(
            views.images, *poses, views.cameras, (config.near, config.far), matcher=views.matcher
        )

    with frames_of(checkouts, of_triple) as folder:
        images = CaptureImages(of_triple, folder, (side, side))
        case = images.case(triple.context, [triple.target], find_range)
    return CaptureCase(to_views(case, config.near), torch.from_numpy(case.targets.valid[0]))


def _psnr(model: IDESplat, case: CaptureCase, device: torch.device) -> float:
    """PSNR in dB of the valid pixels of the held-out image, of values clipped to [0, 1]."""
    views = case.views.to(device)
    predicted = model(views.images, views.extrinsics, views.intrinsics, views.near, views.far)
    rendered = render_targets(predicted.gaussians, views).cpu()
    return psnr(rendered[..., case.valid].clamp(0, 1), case.views.target_images[..., case.valid])
