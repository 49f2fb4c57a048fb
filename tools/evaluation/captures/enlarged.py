"""Predictions from larger images beside those from smaller ones, enlarged.

    python -P -m idesplat.tools.evaluation.captures.enlarged --checkouts DIR

Both render the held-out frames of the triples. What the smaller images give is enlarged by bicubic interpolation to the
larger frame, and rendered at its size, too. Only pixels that both frames show are compared. The sizes are turned for
portrait frames.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rich.table import Table

from ....runtime.cli.terminal import run, say
from ....runtime.images.sizes import parse_size
from ....runtime.inference.named_models import find_model
from ....runtime.inference.predictor import Predictor
from ....runtime.reconstruction.quality import Quality
from ....runtime.reconstruction.steps import make_plan
from ....runtime.splats.filtering import FilterOptions
from ..cases import PosedImages
from ..metrics import psnr, ssim
from ..novel_views import render_target
from ..report import print_table
from .capture import Capture, CaptureImages, Triple, read_captures
from .checkouts import frames_of
from .scores import CaptureEvaluator

# Share of a pixel that the smaller frame must cover.
COVERED = 0.999
COLUMNS = ("larger images", "enlarged", "rendered larger")


def compare(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    capture: Annotated[list[str] | None, typer.Option(help="Use this capture alone; may be repeated.")] = None,
    model: Annotated[Path | None, typer.Option(help="An exported model; else the bundled one.")] = None,
    size: Annotated[str, typer.Option(help="HEIGHTxWIDTH of larger landscape frames.")] = "384x512",
    smaller: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH of smaller ones; else the trained size.", show_default=False)
    ] = None,
) -> None:
    """Measure PSNR and SSIM of held-out frames from two larger images, and from two smaller ones."""
    predictor = Predictor(find_model(model))
    own = predictor.metadata
    sizes = parse_size(smaller) if smaller else (own.height, own.width), parse_size(size)
    plan = make_plan(Quality.STANDARD, predictor.model, "0", FilterOptions(), 0)
    evaluator = CaptureEvaluator(predictor, {}, plan)
    table = Table()
    table.add_column("capture")
    for heading in COLUMNS:
        table.add_column(heading, justify="right")
    means = []
    for source in read_captures(capture or ()):
        means.append(_capture_scores(evaluator, source, checkouts, sizes))
        cells = _cells(means[-1])
        table.add_row(source.name, *cells)
        say(f"{source.name}: " + "; ".join(f"{name} {cell}" for name, cell in zip(COLUMNS, cells, strict=True)))
    table.add_section()
    table.add_row(f"mean of {len(means)}", *_cells(np.mean(means, axis=0)))
    print_table(table)


def enlarge(image: np.ndarray, targets: PosedImages, larger: PosedImages) -> tuple[np.ndarray, np.ndarray]:
    """An image of the first target at the place and size that it has in the larger frame, bicubic, and where it lies.

    image: [height, width, 3], rendered for `targets`. Returns it, [H, W, 3], and bool [H, W]. Both frames are of one
    camera at one pose, so that their intrinsics alone differ.
    """
    height, width = larger.images.shape[2:]
    # Pixel centres are at .5 in K, and at whole numbers for OpenCV.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    matrix = np.linalg.inv(half) @ larger.K(0) @ np.linalg.inv(targets.K(0)) @ half
    shown = cv2.warpAffine(image, matrix[:2], (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpAffine(targets.valid[0].astype(np.float32), matrix[:2], (width, height))
    return shown, inside > COVERED


def _cells(scores: np.ndarray) -> list[str]:
    """PSNR and SSIM of each column, [columns, 2], as text."""
    return [f"{decibels:.2f} dB, {similarity:.3f}" for decibels, similarity in scores]


def _capture_scores(
    evaluator: CaptureEvaluator, source: Capture, checkouts: Path, sizes: Sequence[tuple[int, int]]
) -> np.ndarray:
    """The means of a capture's triples, [columns, 2]. sizes: height and width of smaller and larger landscape ones."""
    camera = source.cameras[source.triples[0].target]
    turned = [size if camera.width >= camera.height else size[::-1] for size in sizes]
    with frames_of(checkouts, source) as folder:
        small, large = (CaptureImages(source, folder, size) for size in turned)
        return np.mean([_triple_scores(evaluator, triple, small, large) for triple in source.triples], axis=0)


def _triple_scores(
    evaluator: CaptureEvaluator, triple: Triple, small: CaptureImages, large: CaptureImages
) -> list[tuple[float, float]]:
    """PSNR and SSIM of a triple's held-out frame, in the order of COLUMNS."""
    cases = [images.case(triple.context, [triple.target], evaluator.predictor.depth_range) for images in (small, large)]
    gaussians = [evaluator.predict(case).gaussians for case in cases]
    targets, larger = (case.targets for case in cases)
    enlarged, inside = enlarge(render_target(gaussians[0], targets, 0).rgb, targets, larger)
    truth, compared = larger.image(0), inside & larger.valid[0]
    images = (render_target(gaussians[1], larger, 0).rgb, enlarged, render_target(gaussians[0], larger, 0).rgb)
    return [(psnr(image, truth, compared), ssim(image, truth, compared)) for image in images]


def main() -> None:
    """Run the command."""
    run(compare)


if __name__ == "__main__":
    main()
