"""The pipeline as a library: a model file or staged folder, arrays in, depth and Gaussians out."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .bundle import Description, StageFile, read_description, read_manifest
from .cameras import Camera
from .depth_range import DepthRange, find_depth_range
from .errors import InputError
from .gaussians import Gaussians
from .scene_frame import SceneFrame
from .session import CPU, USUAL, Tuning, open_session, provider_name, run_session
from .sizes import size_fits, size_rule
from .views import Views, check_views, prepare

FUSED = "model"


@dataclass(frozen=True)
class Prediction:
    """depth: metric z-depth in scene units, float32 [views, height, width].

    gaussians: ordered by view, row, column; None from a depth-only model (`Runner.description.gaussians` is false).
    """

    depth: np.ndarray
    gaussians: Gaussians | None
    # Seconds by stage; a fused file is one stage called "model".
    seconds: dict[str, float] = field(default_factory=dict)

    def need_gaussians(self) -> Gaussians:
        """The Gaussians, for what cannot do without them; raises InputError if there are none."""
        if self.gaussians is None:
            raise InputError("this model predicts depth alone; give one that predicts Gaussians, too")
        return self.gaussians


class Runner:
    """An exported model, ready to run.

    model: a `.onnx` of this project, or a folder that `idesplat-export --staged` wrote.
    provider: an ONNX Runtime execution provider, such as CPU or CUDA.
    tuning: threads and profiling, for those who measure.
    Raises InputError if the model is not ours or damaged, or the provider is not there.
    """

    def __init__(self, model: Path | str, provider: str = CPU, tuning: Tuning = USUAL) -> None:
        self.path = Path(model)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such model; give a .onnx file or staged folder made by idesplat-export")
        provider = provider_name(provider)
        stages = read_manifest(self.path) if self.path.is_dir() else [StageFile(FUSED, self.path.name, [], [])]
        folder = self.path if self.path.is_dir() else self.path.parent
        started = time.perf_counter()
        self._stages = [
            (stage, open_session(folder / stage.file, provider, _profiled(tuning, stage))) for stage in stages
        ]
        self.load_seconds = time.perf_counter() - started
        properties = self._stages[0][1].get_modelmeta().custom_metadata_map
        self.description: Description = read_description(properties, self.path)
        self._keep = _last_uses([stage for stage, _ in self._stages])

    def predict(
        self,
        images: Sequence[Path | np.ndarray],
        cameras: Sequence[Camera],
        near: float | None = None,
        far: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> Prediction:
        """Predict depth and Gaussians from photographs of any size.

        images: files, or RGB [h, w, 3] in uint8. cameras: one for each image, as `read_cameras` gives them.
        near, far: scene units; as `depth_range` finds them where not given. size: height and width to work at.
        Raises InputError for anything that cannot be used.
        """
        if len(images) != len(cameras):
            raise InputError(f"{len(images)} images and {len(cameras)} cameras, expected one camera for each image")
        height, width = size or self.size_for(cameras)
        views = prepare(list(zip(images, cameras, strict=True)), None, height, width)
        found = self.depth_range(views, near, far)
        return self.predict_arrays(views.images, views.extrinsics, views.intrinsics, found.near, found.far)

    def depth_range(self, views: Views, near: float | None = None, far: float | None = None) -> DepthRange:
        """Near and far for these views, and where they come from; what is given stays.

        Raises InputError if near is not before far.
        """
        trained = self.description.near, self.description.far
        return find_depth_range(
            views.images, views.extrinsics, views.intrinsics, views.cameras, trained, near, far, views.samples
        )

    def predict_arrays(
        self,
        images: np.ndarray,  # [views, 3, height, width]
        extrinsics: np.ndarray,  # [views, 4, 4]
        intrinsics: np.ndarray,  # [views, 3, 3]
        near: float | None = None,
        far: float | None = None,
    ) -> Prediction:
        """Predict depth and Gaussians from arrays at a size that the model takes.

        images: RGB in [0, 1]. extrinsics: camera-to-world, OpenCV axes. intrinsics: normalised by width and height.
        near, far: scene units; the model's own range where not given. The network itself works in a frame and unit of
        its own (`SceneFrame`): a scene in any unit gives the same result, in that unit.
        Raises InputError for anything the model cannot take.
        """
        near = self.description.near if near is None else near
        far = self.description.far if far is None else far
        check_views(images, extrinsics, intrinsics, near, far)
        self.check_size(len(images), *np.shape(images)[2:])
        nearest, farthest = (np.full(len(images), depth, np.float64) for depth in (near, far))
        frame = SceneFrame.of(np.asarray(extrinsics), nearest, self.description.near)
        values = {
            "images": np.ascontiguousarray(images, np.float32),
            "extrinsics": frame.enter(extrinsics),
            "intrinsics": np.ascontiguousarray(intrinsics, np.float32),
            "near": (nearest * frame.scale).astype(np.float32),
            "far": (farthest * frame.scale).astype(np.float32),
        }
        return self._run(values, frame)

    def end_profiling(self) -> list[Path]:
        """Stop noting operators, where `tuning.profile` asked for it; the files of notes, one for each stage."""
        return [Path(session.end_profiling()) for _, session in self._stages]

    def size_for(self, cameras: Sequence[Camera]) -> tuple[int, int]:
        """The trained height and width, turned upright where most pictures are and the model leaves the choice."""
        own = self.description
        upright = sum(camera.height > camera.width for camera in cameras) * 2 > len(cameras)
        turn = upright and own.width > own.height and not own.fixed_size
        return (own.width, own.height) if turn else (own.height, own.width)

    def check_size(self, views: int, height: int, width: int) -> None:
        """Raise InputError unless the model takes this many views of this size."""
        own = self.description
        if own.fixed_views and views != own.fixed_views:
            raise InputError(
                f"{self.path}: was exported for {own.fixed_views} views and got {views}; use --views {own.fixed_views}"
            )
        if own.fixed_size and (height, width) != (own.height, own.width):
            raise InputError(
                f"{self.path}: was exported for {own.height}x{own.width} and got {height}x{width}; "
                f"use --size {own.height}x{own.width}, or export without --size"
            )
        if not size_fits(height, width, own.size_multiple):
            rule = size_rule(own.size_multiple)
            raise InputError(f"{self.path}: cannot take images of {height}x{width}; {rule}")

    def _run(self, values: dict[str, np.ndarray], frame: SceneFrame) -> Prediction:
        seconds = {}
        for (stage, session), keep in zip(self._stages, self._keep, strict=True):
            started = time.perf_counter()
            values.update(run_session(session, values))
            seconds[stage.name] = time.perf_counter() - started
            values = {name: value for name, value in values.items() if name in keep or len(self._stages) == 1}
        gaussians = None
        if self.description.gaussians:
            parts = (values[name] for name in ("means", "scales", "quats", "opacities", "sh"))
            gaussians = frame.leave(Gaussians(*parts))
        return Prediction(frame.leave_depth(values["depth"]), gaussians, seconds)


def _profiled(tuning: Tuning, stage: StageFile) -> Tuning:
    """`tuning` with a file of notes of the stage's own."""
    if tuning.profile is None:
        return tuning
    return replace(tuning, profile=tuning.profile.with_name(f"{tuning.profile.name}-{stage.name}"))


def _last_uses(stages: list[StageFile]) -> list[set[str]]:
    """For each stage, the tensors that are still needed after it: later stages' inputs, or the last one's outputs."""
    needed = set(stages[-1].outputs)
    keep = []
    for stage in reversed(stages):
        keep.append(set(needed))
        needed |= set(stage.inputs)
    return keep[::-1]
