"""How well a network in training does on the validation scenes, in numbers and in pictures."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ...model.common.layers import resize
from ...model.idesplat.network import IDESplat
from ..synthetic.sampler import VALIDATION_SEEDS
from .log import picture, strip, write_rows
from .scenes import SampleSpec, Views
from .schedule import Phase
from .step import PhaseOutput, measures, run_phase

SCENES = 8
PICTURED = 4


@torch.no_grad()
def validate(
    model: IDESplat, phase: Phase, side: int, load: Callable[[SampleSpec], Views], pictures: Path
) -> dict[str, float]:
    """The mean measures of the first validation scenes, of two context views of `side` pixels; writes `pictures`."""
    entries: list[dict[str, float]] = []
    rows: list[np.ndarray] = []
    for seed in VALIDATION_SEEDS[:SCENES]:
        views = load(SampleSpec(seed, 2, (1,) * phase.gaussians, side, side))
        outcome = run_phase(model, views, phase)
        entries.append(measures(outcome, views))
        if len(rows) < PICTURED:
            rows.append(_row(views, outcome))
    write_rows(pictures, rows)
    return {f"validation_{name}": sum(entry[name] for entry in entries) / SCENES for name in entries[0]}


def _row(views: Views, outcome: PhaseOutput) -> np.ndarray:
    """Photograph, truth, prediction and error of the first view, then the first novel view and its rendering."""
    predicted = resize(outcome.inverse_depth, *views.images.shape[2:])[0, 0]
    truth = None if views.inverse_depth is None else views.inverse_depth[0].numpy()
    row = [strip(views.images[0].numpy(), truth, predicted.numpy())]
    if outcome.rendered is not None:
        row += [picture(views.target_images[0].numpy()), picture(outcome.rendered[0].numpy())]
    return np.concatenate(row, axis=1)
