"""Prediction with an exported model: images and cameras in, depth and Gaussians out."""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError, error_context
from ..geometry.intrinsics import denormalize_intrinsics
from ..images.arrays import as_uint8_image
from ..splats.gaussians import Gaussians
from ..views.batch import ViewBatch, build_view_batch, check_view_arrays
from ..views.depth_range import DepthRange, estimate_depth_range
from .graph_check import check_fused, check_results, check_stage
from .metadata import ModelMetadata, StageFile, expected_outputs
from .model_files import ModelFiles, read_model
from .normalization import SceneNormalization
from .providers import CPU, candidates
from .session import DEFAULT, SessionConfig, open_session, run_limit_s, run_on_device, run_session

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prediction:
    """depth: metric z-depth in scene units, float32 [views, height, width].

    gaussians: ordered by view, row, column; None from a depth-only model (`Predictor.metadata.gaussians` is false).
    cameras: the views' cameras at the size of the depth maps, [views]: K in pixels of these, pixel centres at .5, poses
    camera-to-world with OpenCV axes, no distortion, `depth_range` near and far. With them, depth leads back to points.
    """

    depth: np.ndarray
    gaussians: Gaussians | None
    # Seconds by stage; a single file is one stage called "model".
    seconds: dict[str, float] = field(default_factory=dict)
    cameras: list[Camera] = field(default_factory=list)

    def need_gaussians(self) -> Gaussians:
        """The Gaussians; raises InputError if the model predicts depth only."""
        if self.gaussians is None:
            raise InputError("this model predicts depth only; give one that predicts Gaussians, too")
        return self.gaussians


class Predictor:
    """An exported model, loaded.

    model: a `.onnx` of this project, a folder that `idesplat-export --staged` wrote, or what `read_model` returns.
    provider: an ONNX Runtime execution provider, such as "CPU" or "CUDA", or "auto" for a GPU where one works, else the
    CPU; the attribute `provider` is the one that it runs on. config: the provider's device and options, threads,
    profiling.
    Raises InputError if the model is not of this project or damaged, or the provider is not installed.
    """

    def __init__(self, model: Path | str | ModelFiles, provider: str = CPU, config: SessionConfig = DEFAULT) -> None:
        self.model = model if isinstance(model, ModelFiles) else read_model(model)
        started = time.perf_counter()
        for self.provider in (tried := candidates(provider)):
            try:
                self._sessions = [
                    open_session(self.model.file_of(stage), self.provider, _profiled(config, stage))
                    for stage in self.model.stages
                ]
                break
            except InputError as error:
                if self.provider == tried[-1]:
                    raise
                LOG.info("%s", error)
        self.load_seconds = time.perf_counter() - started
        try:
            self._check_graphs()
        except UnicodeDecodeError:
            raise InputError(f"{self.model.path}: damaged: names in its graph are not UTF-8; export it again") from None
        self._keep = _last_uses(self.model.stages)

    @property
    def metadata(self) -> ModelMetadata:
        """The model's metadata."""
        return self.model.metadata

    def predict(
        self,
        images: Sequence[Path | np.ndarray],
        cameras: Sequence[Camera],
        near: float | None = None,
        far: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> Prediction:
        """Predict depth and Gaussians from images of any size.

        images: files, or RGB [h, w, 3], as uint8 in 0 to 255 or as floating point in [0, 1], which is rounded to 8 bits
        as files have them. cameras: one for each image, as `read_cameras` gives them. near, far: scene units; estimated
        by `depth_range` where not given. size: height and width to which the images are cropped and resized; the
        trained size by default. Raises InputError for images or cameras that cannot be used.
        """
        if len(images) != len(cameras):
            raise InputError(f"{len(images)} images and {len(cameras)} cameras, expected one camera for each image")
        height, width = size or self.model.size_for(cameras)
        self.model.check_size(len(images), height, width)
        given = [
            (as_uint8_image(image, camera.name) if isinstance(image, np.ndarray) else image, camera)
            for image, camera in zip(images, cameras, strict=True)
        ]
        return self.predict_views(build_view_batch(given, None, height, width), near, far)

    def predict_views(self, views: ViewBatch, near: float | None = None, far: float | None = None) -> Prediction:
        """Predict depth and Gaussians from views as `build_view_batch` makes them.

        near, far: scene units; estimated by `depth_range` where not given.
        Raises InputError for views that the model does not take.
        """
        span = self.depth_range(views, near, far)
        return self._predict(views.images, views.extrinsics, views.intrinsics, span.near, span.far, views.names)

    def depth_range(self, views: ViewBatch, near: float | None = None, far: float | None = None) -> DepthRange:
        """Near and far for these views, and their source; values that are given are kept.

        Raises InputError if near is not before far.
        """
        trained = self.metadata.near, self.metadata.far
        return estimate_depth_range(
            views.images, views.extrinsics, views.intrinsics, views.cameras, trained, near, far, views.matcher
        )

    def predict_arrays(
        self,
        images: np.ndarray,  # [views, 3, height, width]
        extrinsics: np.ndarray,  # [views, 4, 4]
        intrinsics: np.ndarray,  # [views, 3, 3]
        near: float | np.ndarray | None = None,
        far: float | np.ndarray | None = None,
    ) -> Prediction:
        """Predict depth and Gaussians from arrays at a size that the model takes.

        images: RGB in [0, 1], floating point. extrinsics: camera-to-world, OpenCV axes, in any unit. intrinsics: row 0
        divided by the width, row 1 by the height; pixel centres at .5. near, far: in the unit of the poses, one number
        or one for each view; estimated by `depth_range` where not given, from points matched between the views or from
        their baseline. The range in training does not apply: its unit is another. The network works in a normalised
        frame and unit (`SceneNormalization`): a scene in any unit gives the same result, in that unit. Raises
        InputError for arrays that the model does not take.
        """
        check_view_arrays(images, extrinsics, intrinsics, near, far)
        self.model.check_size(len(images), *np.shape(images)[2:])
        arrays = np.asarray(images), np.asarray(extrinsics), np.asarray(intrinsics)
        if near is None or far is None:
            trained = self.metadata.near, self.metadata.far
            nearest = None if near is None else float(np.min(near))
            farthest = None if far is None else float(np.max(far))
            span = estimate_depth_range(*arrays, (), trained, near=nearest, far=farthest)
            near, far = span.near if near is None else near, span.far if far is None else far
        return self._predict(*arrays, near, far, [f"view {index}" for index in range(len(images))])

    def _predict(
        self,
        images: np.ndarray,
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        near: float | np.ndarray,
        far: float | np.ndarray,
        names: Sequence[str],
    ) -> Prediction:
        """`predict_arrays`, with the names of the views."""
        check_view_arrays(images, extrinsics, intrinsics, near, far)
        views, _, height, width = images.shape
        self.model.check_size(views, height, width)
        nearest, farthest = (np.full(views, depth, np.float64) for depth in (near, far))
        frame = SceneNormalization.of(extrinsics, nearest, self.metadata.near)
        values = {
            "images": np.ascontiguousarray(images, np.float32),
            "extrinsics": frame.apply(extrinsics),
            "intrinsics": np.ascontiguousarray(intrinsics, np.float32),
            "near": (nearest * frame.scale).astype(np.float32),
            "far": (farthest * frame.scale).astype(np.float32),
        }
        Ks = denormalize_intrinsics(intrinsics, width, height)  # [views, 3, 3]
        ranges = zip(nearest.tolist(), farthest.tolist(), strict=True)
        cameras = [
            Camera(name, width, height, K, pose, depth_range=span)
            for name, K, pose, span in zip(names, Ks, extrinsics, ranges, strict=True)
        ]
        return replace(self._run(values, frame), cameras=cameras)

    def _check_graphs(self) -> None:
        """Raise InputError unless the graphs are what metadata and manifest say of them."""
        model = self.model
        if not model.path.is_dir():
            check_fused(model.path, self._sessions[0], model.metadata)
            return
        types: dict[str, str] = {}
        for stage, session in zip(model.stages, self._sessions, strict=True):
            check_stage(model.file_of(stage), session, stage.inputs, stage.outputs, model.metadata, types)
        missing = [name for name in expected_outputs(model.metadata) if name not in types]
        if missing:
            raise InputError(f"{model.path}: no stage yields {missing[0]}; export it again")

    def end_profiling(self) -> list[Path]:
        """Stop profiling, if `config.profile` was given; returns the profiles, one file for each stage."""
        return [Path(session.end_profiling()) for session in self._sessions]

    def _run(self, inputs: Mapping[str, np.ndarray], frame: SceneNormalization) -> Prediction:
        path, seconds = self.model.path, {}
        views, _, height, width = inputs["images"].shape
        limit_s = run_limit_s(views * height * width)
        values: dict[str, Any] = dict(inputs)
        results = self.model.stages[-1].outputs
        for stage, session, keep in zip(self.model.stages, self._sessions, self._keep, strict=True):
            started = time.perf_counter()
            with error_context(f"{path}: stage {stage.name}" if path.is_dir() else str(path)):
                if len(self._sessions) > 1 and self.provider.memory:
                    # Tensors between stages stay in the GPU's memory, without a copy to the CPU's and back.
                    between = set(stage.outputs) - set(results)
                    run = run_on_device(session, values, stage.outputs, limit_s, between, self.provider.memory)
                else:
                    run = run_session(session, values, stage.outputs, limit_s)
                values.update(run)
            seconds[stage.name] = time.perf_counter() - started
            values = {name: value for name, value in values.items() if name in keep}
        with error_context(str(path)):
            check_results(values, views, height, width, self.metadata)
        gaussians = None
        if self.metadata.gaussians:
            parts = (values[name] for name in ("means", "scales", "quats", "opacities", "sh"))
            gaussians = frame.invert(Gaussians(*parts))
        return Prediction(frame.invert_depth(values["depth"]), gaussians, seconds)


def _profiled(config: SessionConfig, stage: StageFile) -> SessionConfig:
    """`config` with a profile of the stage's own."""
    if config.profile is None:
        return config
    return replace(config, profile=config.profile.with_name(f"{config.profile.name}-{stage.name}"))


def _last_uses(stages: list[StageFile]) -> list[set[str]]:
    """For each stage, the tensors that are needed after it: inputs of later stages, or outputs of the last."""
    needed = set(stages[-1].outputs)
    keep = []
    for stage in reversed(stages):
        keep.append(set(needed))
        needed |= set(stage.inputs)
    return keep[::-1]
