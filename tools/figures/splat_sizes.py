"""Size of oracle-depth splats: PSNR by splat size, at the images' own size and zoomed in.

    python -P -m idesplat.tools.figures.splat_sizes --scenes 24

Small splats occlude little of their neighbours and score best at the images' own size; zoomed in, they leave gaps.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...runtime.cli.terminal import run
from ...runtime.inference.bundled_model import bundled_model
from ...runtime.inference.predictor import Predictor
from ...runtime.splats.gaussians import Gaussians
from ...runtime.system.progress import progress
from ..evaluation.baselines import SPLAT_PIXELS, oracle_depth_splats
from ..evaluation.cases import EvalCase, synthetic_case
from ..evaluation.metrics import psnr
from ..evaluation.novel_views import render_target
from ..synthetic.sampler import HELD_OUT_SEEDS

ZOOMS = (1, 2, 4)
SIZES = (0.3, 0.35, 0.4, 0.45, 0.5, 0.6)  # pixels
VIEWS, TARGETS = 2, 2
OWN = "model"


def main(
    model: Annotated[Path | None, typer.Argument(help="A .onnx file instead of the bundled model.")] = None,
    scenes: Annotated[int, typer.Option(help="Held-out synthetic scenes.", min=1)] = 24,
) -> None:
    """Compare oracle-depth splats of several sizes and the model's splats on held-out scenes."""
    predictor = Predictor(model or bundled_model())
    table = Table("zoom", *(f"{size:g} pixels" for size in SIZES), OWN, title="PSNR, dB, co-visible pixels")
    for zoom in ZOOMS:
        seeds = progress(HELD_OUT_SEEDS[:scenes], f"zoom {zoom}")
        rows = [row for seed in seeds for row in _measured(predictor, seed, zoom)]
        table.add_row(str(zoom), *(f"{value:.2f}" for value in np.mean(rows, axis=0)))
    Console().print(table)


def _measured(predictor: Predictor, seed: int, zoom: int) -> list[list[float]]:
    """PSNR in dB of each target of a scene, by splat size; last, of the model's splats."""
    own = predictor.metadata
    case = synthetic_case(seed, VIEWS, VIEWS, TARGETS, own.height, own.width, zoom)
    given = case.context
    predicted = predictor.predict_arrays(given.images, given.extrinsics, given.intrinsics, case.near, case.far)
    assert case.depth is not None
    rule = oracle_depth_splats(case.depth, given)
    scenes = [replace(rule, scales=rule.scales * np.float32(size / SPLAT_PIXELS)) for size in SIZES]
    return [[_psnr(scene, case, view) for scene in (*scenes, predicted.need_gaussians())] for view in range(TARGETS)]


def _psnr(gaussians: Gaussians, case: EvalCase, view: int) -> float:
    assert case.covisible is not None
    return psnr(render_target(gaussians, case.targets, view).rgb, case.targets.image(view), case.covisible[view])


if __name__ == "__main__":
    run(main)
