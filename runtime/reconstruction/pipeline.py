"""Images to Gaussians in one function: what `idesplat infer` does, as a library."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..cameras.formats import CameraFormat
from ..inference.inputs import Inputs, Request, read_inputs
from ..inference.model_files import ModelFiles, read_model
from ..inference.named_models import find_model
from ..inference.predictor import Predictor
from ..inference.providers import AUTO, CPU, candidates
from ..inference.session import DEFAULT, SessionConfig
from ..splats.filtering import FilterOptions
from ..system.progress import CALLBACK, ProgressCallback, reporting_to, working
from ..views.exposure import compensate_exposure
from ..views.exposure_mode import ExposureMode, parse_exposure_mode
from ..views.world_offset import apply_offset, parse_offset
from .bounds import check_depth_bounds
from .many_views import predict_views
from .quality import Quality
from .result import Reconstruction
from .steps import fuse, make_plan, refine_prediction

LOG = logging.getLogger(__name__)

Images = Path | str | Sequence[Path | str | np.ndarray]


def reconstruct(
    images: Images,
    cameras: Path | str | Sequence[Camera] | None = None,
    *,
    model: Path | str | ModelFiles | Predictor | None = None,
    camera_format: CameraFormat | str | None = None,
    focal: str | None = None,
    select: str | None = None,
    views: int | str | None = None,
    size: tuple[int, int] | None = None,
    crop: bool = False,
    quality: Quality | str | None = None,
    refine: str | None = None,
    max_gaussians: int = 0,
    near: float | None = None,
    far: float | None = None,
    offset: str | None = None,
    exposure: str = ExposureMode.AUTO,
    provider: str = CPU,
    session: SessionConfig = DEFAULT,
    filters: FilterOptions | None = None,
    on_inputs: Callable[[Inputs], None] | None = None,
    on_step: Callable[[int, float], bool] | None = None,
    progress: ProgressCallback | None = None,
) -> Reconstruction:
    """Depth and Gaussians from images: predicted, fused over the views, and refined on the images.

    images: a folder, a glob, a video, or a sequence of image files; or arrays, RGB [h, w, 3], uint8 in 0 to 255 or
    floating point in [0, 1], together with `cameras` as a sequence.
    cameras: a file or folder of any known format (`camera_format` where its content does not tell it); `Camera`s, one
    for each array, or whose names are those of the image files; "estimate"; or None for the cameras beside the images,
    estimated where there are none (`focal`: focal length in pixels such as "1375", or on 35 mm film such as "26mm").
    model: a .onnx file or staged folder instead of the bundled model, or the name of one (`find_model`); or a
    `Predictor`, which stays open for further scenes, and has a provider and a session already.
    provider: the ONNX Runtime execution provider, or "auto". session: its device and options, and threads.
    select: images to use, as names or numbers ("0-3", "0:8:2"). views: how many of them, by the best baselines, or
    "all"; by default as many as the quality says, or all that `select` names.
    quality: "fast", "standard" or "high" (`quality.PRESETS`); by default standard with the bundled model, and with
    another one fast, the prediction as it is. refine: instead of the quality's, steps of refinement ("100", "0") or its
    time ("30s"). max_gaussians: how many to keep at most, those that contribute most; 0 for all.
    size: height and width to work at instead of the images' own shape (`enlarging` says what the network gets of large
    ones). crop: work at the trained size, on the middle of the images.
    near, far: bounds of depth in scene units; found from matched points or the baseline where not given.
    offset: "auto" or "X,Y,Z", subtracted from world coordinates that float32 does not hold.
    exposure: "auto" brings the views to a common exposure and white balance where these differ; "off" leaves the images
    as they are, for the plain prediction of a model.
    on_inputs: called with the chosen views before the model is loaded; its exceptions propagate. on_step: called with
    each step of the refinement and its view's PSNR; ends the refinement by returning False.
    progress: receives reports of progress, see `Progress` in `idesplat.runtime.system.progress`.
    Raises InputError for invalid or unreadable inputs.
    """
    check_depth_bounds(near, far)
    candidates(provider)
    parse_offset(offset or "auto")
    mode = parse_exposure_mode(exposure)
    with reporting_to(progress or CALLBACK.get()):
        opened = model if isinstance(model, Predictor) else None
        files = _files_of(model)
        plan = make_plan(quality, files, refine, filters or FilterOptions(), max_gaussians)
        started = time.perf_counter()
        request = Request(
            [images] if isinstance(images, (str, Path)) else list(images),
            cameras,
            CameraFormat(camera_format) if camera_format else None,
            focal,
            select,
            views,
            size,
            crop,
            plan.preset.pixels,
            plan.preset.views,
            plan.copy_side,
        )
        inputs = read_inputs(request, files)
        LOG.info("views %s, cameras %s", ", ".join(inputs.views.names), inputs.source)
        if on_inputs is not None:
            on_inputs(inputs)
        prepared = time.perf_counter()
        with working("loading the model"):
            predictor = opened or Predictor(files, provider, session)
        load_seconds = 0.0 if opened else predictor.load_seconds
        loaded = time.perf_counter()
        ran_on = predictor.provider.name
        if provider.lower() == AUTO:
            inputs.notes.append(f"ran on {ran_on}")
        LOG.info("loaded %s on %s in %.2f s", files.path, ran_on, load_seconds)
        with working("finding near and far"):
            span = predictor.depth_range(inputs.views, near, far)
        with working("comparing exposures"):
            exposed, found = compensate_exposure(inputs.views, mode)
        placed, notes = apply_offset(exposed, offset, span.near)
        seconds = {"load": load_seconds, "prepare": prepared - started + time.perf_counter() - loaded}
        with working("predicting depth and Gaussians"):
            prediction = predict_views(predictor, placed, span, near, far, for_fusion=plan.fuses)
        LOG.info("predicted in %s", ", ".join(f"{name} {value:.2f} s" for name, value in prediction.seconds.items()))
        del predictor  # its memory is needed for the refinement, unless the caller keeps it open
        seconds |= prediction.seconds
        fused = fuse(prediction, placed, span, plan)
        del prediction  # fusion keeps a third of many views: the rest would stay in memory during the refinement
        finished = refine_prediction(fused.prediction, placed, plan, on_step)
    return Reconstruction(
        finished.prediction,
        replace(inputs, views=placed),
        files,
        span,
        plan.filters,
        fused.removed,
        seconds | fused.seconds | finished.seconds,
        inputs.notes + found.notes + notes + fused.notes + finished.notes,
        found,
        finished.psnr,
        finished.exposure,
    )


def _files_of(model: Path | str | ModelFiles | Predictor | None) -> ModelFiles:
    if isinstance(model, Predictor):
        return model.model
    return model if isinstance(model, ModelFiles) else read_model(find_model(model))
