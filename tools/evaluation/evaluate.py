"""Evaluation of an exported model on held-out views: the library behind `idesplat eval`.

`evaluate` takes images with cameras, `evaluate_chunks` the released datasets, `evaluate_synthetic` the held-out
synthetic scenes and `evaluate_captures` real captures. They print nothing; progress goes to the callback of
`runtime.system.progress`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...runtime.cameras.camera import Camera
from ...runtime.cameras.io import read_cameras
from ...runtime.errors import InputError
from ...runtime.images.finding import find_images
from ...runtime.inference.metadata import ModelMetadata
from ...runtime.inference.named_models import find_model
from ...runtime.inference.predictor import Predictor
from ...runtime.inference.session import SessionConfig
from ...runtime.reconstruction.quality import Quality
from ...runtime.reconstruction.steps import make_plan
from ...runtime.splats.filtering import FilterOptions
from ...runtime.system.progress import progress
from ...runtime.views.batch import match_images_to_cameras
from ...runtime.views.exposure_mode import ExposureMode, parse_exposure_mode
from .captures.capture import CaptureImages, read_captures
from .captures.checkouts import clones_folder, frames_of
from .captures.scores import CaptureEvaluator, CaptureScores, Show
from .cases import EvalCase, synthetic_case
from .chunks import NEAR_PLANE_FACTOR, chunk_cases, find_chunks, read_index
from .defaults import CONTEXT_VIEWS, HELD_OUT_SCENES, HOLD_OUT_EVERY, SYNTHETIC_TARGETS, VIEW_COUNTS
from .image_folders import load_case, split_frames
from .metrics import LITE0, LPIPS, PerceptualMetric, check_ssim, load_lite0, load_lpips
from .novel_views import Evaluator, Result, Scores, mean_of_scenes, mean_of_views

# Receives a scene's metrics and, by target, its strip: truth, render, error, depth and, if measured, the oracle plane.
OnScene = Callable[[Result, dict[str, np.ndarray]], None]


class ModelOn(NamedTuple):
    """A model and where it runs: the execution provider, its device and options, and threads."""

    path: Path
    provider: str
    session: SessionConfig


Model = Predictor | ModelOn | Path | str | None


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    model, metadata: the model that was evaluated. size: height and width that it worked at.
    mean: metrics by method ("model", "nearest", "oracle_plane", "oracle_depth"), averaged over target views
    (`evaluate`), or over scenes (`evaluate_chunks`, `evaluate_synthetic`).
    scenes: every scene with its targets. skipped: scenes that cannot be used, and why.
    missing: scenes of an index that are not in the data. warnings: metrics that could not be computed, and why.
    """

    model: Path
    metadata: ModelMetadata
    size: tuple[int, int]
    mean: Scores
    scenes: list[Result]
    skipped: dict[str, str] = field(default_factory=dict)
    missing: int = 0
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class CaptureEvaluation:
    """What an evaluation on captures found; view_counts: the numbers of context views. Else as `Evaluation`."""

    model: Path
    metadata: ModelMetadata
    size: tuple[int, int]
    view_counts: list[int]
    captures: list[CaptureScores]
    warnings: list[str] = field(default_factory=list)


def evaluate(
    images: Path | str | Sequence[Path | str],
    cameras: Path | str | Sequence[Camera],
    model: Model = None,
    *,
    context: Sequence[str] = (),
    targets: Sequence[str] = (),
    views: int | None = None,
    hold_out_every: int = HOLD_OUT_EVERY,
    depth: Path | None = None,
    size: tuple[int, int] | None = None,
    near: float | None = None,
    far: float | None = None,
    on_scene: OnScene | None = None,
) -> Evaluation:
    """Hold images out, infer from others, render the held-out views and compare.

    images: a folder, or files. cameras: their cameras, or a file of them, such as a transforms.json.
    model: an exported model, opened or not; by default the bundled one.
    context, targets: names of images to infer from and to hold out. Without targets, one of every `hold_out_every`
    images is held out; without a context, each target gets the `views` images around it (2 by default).
    depth: a folder of true depth as make_scene writes it, to measure depth as well. size: height and width to work at.
    near, far: depth range in scene units, instead of one estimated from the context views.
    Raises InputError for images, cameras and names that cannot be used, and for what the model cannot take.

        found = evaluate("photos", "photos/transforms.json")
        print(found.mean["model"]["psnr"])
    """
    if views is not None and context:
        raise InputError("views and context: expected one of them; context names the views that there are")
    files = find_images([Path(images)] if isinstance(images, Path | str) else [Path(image) for image in images])
    known = read_cameras(Path(cameras), files) if isinstance(cameras, Path | str) else list(cameras)
    frames = match_images_to_cameras(files, known)
    predictor = _opened(model)
    count = predictor.model.view_count(views, None, CONTEXT_VIEWS) or CONTEXT_VIEWS
    splits = split_frames(frames, context, targets, count, hold_out_every)
    shape = size or predictor.model.size_for([camera for _, camera in frames])
    for given, _ in splits:
        predictor.model.check_size(len(given), *shape)
    find_range = partial(predictor.depth_range, near=near, far=far)
    cases = (load_case(frames, *split, shape, find_range, depth) for split in splits)
    perceptual, warnings = _load_metrics()
    results = _evaluate_cases(cases, len(splits), Evaluator(predictor, perceptual), on_scene)
    return _evaluation(predictor, shape, mean_of_views(results), results, warnings=warnings)


def evaluate_chunks(
    folder: Path,
    index: Path,
    model: Model = None,
    *,
    near: float | None = None,
    far: float | None = None,
    on_scene: OnScene | None = None,
) -> Evaluation:
    """Evaluate on RealEstate10K, ACID or DL3DV as the papers do, at the model's trained size.

    folder: of pixelSplat's .torch chunks. index: a published evaluation index. near, far: in scene units, instead of
    the model's own. Scenes that cannot be used are skipped, as the releases do. Raises InputError if none is left.
    """
    entries, files = read_index(index), find_chunks(folder)
    predictor = _opened(model)
    own = predictor.metadata
    shape = own.height, own.width
    for views in sorted({len(entry.context) for entry in entries.values()}):
        predictor.model.check_size(views, *shape)
    near, far = near if near is not None else own.near, far if far is not None else own.far
    if not 0 < near < far:
        raise InputError(
            f"near {near:g} and far {far:g}: expected 0 < near < far; give --near and --far in scene units"
        )
    perceptual, warnings = _load_metrics()
    evaluator = Evaluator(predictor, perceptual, compare=False, near_plane=NEAR_PLANE_FACTOR * near)
    skipped: dict[str, str] = {}
    cases = chunk_cases(files, entries, shape, (near, far), skipped.__setitem__)
    results = _evaluate_cases(cases, len(entries), evaluator, on_scene, skipped)
    missing = len(entries) - len(results) - len(skipped)
    if not results:
        raise InputError(
            f"{index}: of its {len(entries)} scenes {missing} are not in {folder} and {len(skipped)} cannot be used; "
            "give the chunks of the test set that the index was made for"
        )
    return _evaluation(predictor, shape, mean_of_scenes(results), results, skipped, missing, warnings)


def evaluate_synthetic(
    model: Model = None,
    *,
    scenes: int = HELD_OUT_SCENES,
    views: int = CONTEXT_VIEWS,
    pool_views: int | None = None,
    size: tuple[int, int] | None = None,
    on_scene: OnScene | None = None,
) -> Evaluation:
    """Evaluate on the first `scenes` held-out synthetic scenes: depth against the truth, and novel views.

    views: context views of each scene. pool_views: render this many context views and give `views` of them, evenly
    spaced, so that numbers of views can be compared on the same scenes.
    """
    from ..synthetic.sampler import HELD_OUT_SEEDS

    predictor = _opened(model)
    shape = size or (predictor.metadata.height, predictor.metadata.width)
    predictor.model.check_size(views, *shape)
    pool = views if pool_views is None else pool_views
    if pool < views:
        raise InputError(f"--pool-views {pool}: expected at least the {views} of --views")
    cases = (synthetic_case(seed, views, pool, SYNTHETIC_TARGETS, *shape) for seed in HELD_OUT_SEEDS[:scenes])
    perceptual, warnings = _load_metrics()
    results = _evaluate_cases(cases, scenes, Evaluator(predictor, perceptual), on_scene)
    return _evaluation(predictor, shape, mean_of_scenes(results), results, warnings=warnings)


def evaluate_captures(
    checkouts: Path | None = None,
    model: Model = None,
    *,
    captures: Sequence[str] = (),
    view_counts: Sequence[int] = VIEW_COUNTS,
    size: tuple[int, int] | None = None,
    quality: Quality | str | None = None,
    refine: str | None = None,
    exposure: str = ExposureMode.AUTO,
    filters: FilterOptions | None = None,
    on_target: Show | None = None,
) -> CaptureEvaluation:
    """Evaluate on real captures at pinned commits of public repositories.

    checkouts: a folder of checkouts, each OWNER+NAME or OWNER/NAME; missing ones are cloned into it, or into the user's
    cache if no folder is given. captures: names of some of them instead of all. view_counts: numbers of context views;
    2 are the triples. quality, refine, exposure, filters: as for `reconstruct`. on_target: receives a name and a strip
    for each held-out frame.
    Raises InputError for unknown captures, and where git or the network fails.
    """
    chosen = read_captures(captures)
    predictor = _opened(model)
    shape = size or (predictor.metadata.height, predictor.metadata.width)
    for count in view_counts:
        predictor.model.check_size(count, *shape)
    folder = checkouts or clones_folder()
    perceptual, warnings = _load_metrics()
    plan = make_plan(quality, predictor.model, refine, filters or FilterOptions(), 0)
    evaluator, found = CaptureEvaluator(predictor, perceptual, plan, parse_exposure_mode(exposure)), []
    for capture in progress(chosen, "evaluating"):
        with frames_of(folder, capture) as images:
            loaded = CaptureImages(capture, images, shape)
            found.append(evaluator.evaluate(capture, loaded, view_counts, on_target))
    return CaptureEvaluation(predictor.model.path, predictor.metadata, shape, list(view_counts), found, warnings)


def _opened(model: Model) -> Predictor:
    if isinstance(model, ModelOn):
        return Predictor(*model)
    return Predictor(find_model(model)) if model is None or isinstance(model, Path | str) else model


def _load_metrics() -> tuple[dict[str, PerceptualMetric], list[str]]:
    """The perceptual distances by name, and why others cannot be computed. Raises InputError if there is no SSIM."""
    check_ssim()
    found: dict[str, PerceptualMetric] = {}
    warnings = []
    for name, load in ((LPIPS, load_lpips), (LITE0, load_lite0)):
        try:
            found[name] = load()
        except InputError as error:
            warnings.append(str(error))
    return found, warnings


def _evaluate_cases(
    cases: Iterable[EvalCase],
    total: int,
    evaluator: Evaluator,
    on_scene: OnScene | None,
    skipped: dict[str, str] | None = None,
) -> list[Result]:
    """Evaluate cases. skipped: takes those that the model cannot take; without it that is an error."""
    results: list[Result] = []
    for case in progress(cases, "evaluating", total):
        strips: dict[str, np.ndarray] = {}
        try:
            results.append(evaluator.evaluate(case, None if on_scene is None else strips.__setitem__))
        except InputError as error:
            if skipped is None:
                raise
            skipped[case.name] = str(error)
            continue
        if on_scene is not None:
            on_scene(results[-1], strips)
    return results


def _evaluation(
    predictor: Predictor,
    size: tuple[int, int],
    mean: Scores,
    results: list[Result],
    skipped: dict[str, str] | None = None,
    missing: int = 0,
    warnings: Sequence[str] = (),
) -> Evaluation:
    model = predictor.model.path
    return Evaluation(model, predictor.metadata, size, mean, results, skipped or {}, missing, list(warnings))
