"""Validation of a network in training: metrics and predictions on validation scenes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ...model.common.layers import resize
from ...model.idesplat.network import IDESplat
from ..synthetic.sampler import VALIDATION_SEEDS
from .data.samples import SampleSpec, TrainingViews
from .plots import compare_depth, to_bgr, write_rows
from .schedule import Phase
from .step import PhaseOutput, run_phase, scene_metrics

SCENES = 8
# Scenes whose predictions are written as images.
SHOWN_SCENES = 4


@torch.no_grad()
def validate(
    model: IDESplat, phase: Phase, side: int, load: Callable[[SampleSpec], TrainingViews], predictions: Path
) -> dict[str, float]:
    """Mean metrics over the first validation scenes, with two context views of `side` pixels.

    load: gives the views of a sample. predictions: the PNG that is written.
    """
    entries: list[dict[str, float]] = []
    rows: list[np.ndarray] = []
    for seed in VALIDATION_SEEDS[:SCENES]:
        views = load(SampleSpec(seed, 2, (1,) * phase.gaussians, side, side))
        views = views.to(next(model.parameters()).device)
        output = run_phase(model, views, phase)
        entries.append(scene_metrics(output, views))
        if len(rows) < SHOWN_SCENES:
            rows.append(_row(views, output))
    write_rows(predictions, rows)
    return {f"validation_{name}": sum(entry[name] for entry in entries) / SCENES for name in entries[0]}


def _row(views: TrainingViews, output: PhaseOutput) -> np.ndarray:
    """Image, truth, prediction and error of the first view, then the first target view and its rendering."""
    predicted = resize(output.inverse_depth, *views.images.shape[2:])[0, 0]
    truth = None if views.inverse_depth is None else views.inverse_depth[0].cpu().numpy()
    row = [compare_depth(views.images[0].cpu().numpy(), truth, predicted.cpu().numpy())]
    if output.rendered is not None:
        row += [to_bgr(views.target_images[0].cpu().numpy()), to_bgr(output.rendered[0].cpu().numpy())]
    return np.concatenate(row, axis=1)
