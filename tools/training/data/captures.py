"""Training samples of captures: folders of images with transforms.json, without true depth.

Every eighth image of a folder, from the first in the order of its transforms.json, is held out. Validation renders
these from the other images; training uses none of them.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ....runtime.cameras.camera import Camera
from ....runtime.cameras.io import read_cameras
from ....runtime.errors import InputError
from ....runtime.inference.normalization import SceneNormalization
from ....runtime.views.batch import ViewBatch, build_view_batch
from ....runtime.views.depth_range import estimate_depth_range
from ....runtime.views.loader import load_view
from ...synthetic.views import zoom_intrinsics
from .pointmaps import check_pointmap, load_pointmap
from .samples import SampleSpec, TrainingViews

CAMERAS = "transforms.json"
# After the first context view, the others are chosen among this many nearest cameras, and the targets among as many
# cameras nearest to the mean position of the context.
NEIGHBOURHOOD = 4
# A viewing direction that differs by this angle doubles the distance.
ANGLE_SCALE_DEG = 30.0
# One of so many images is held out, as in the published splits of such captures.
HOLD_OUT_EVERY = 8
MIN_TRAINING_IMAGES = 4

PosedPaths = list[tuple[Path, Camera]]


class CaptureScenes:
    """Training samples from folders; the same specification gives the same sample.

    for_training, held_out: for each folder, its images with their cameras.
    """

    def __init__(self, folders: Sequence[Path], near: float, far: float, pointmaps: Path | None = None) -> None:
        """Read the folders' cameras; raises InputError if cameras, images or pointmaps are missing, or too few.

        near, far: the depth range that the network is trained for. As in inference, scenes are scaled to this near.
        pointmaps: folder with a pointmap for each image, FOLDER/IMAGE.npy (`data.pointmaps`).
        """
        self.pointmaps = pointmaps
        self.for_training: list[PosedPaths] = []
        self.held_out: list[PosedPaths] = []
        for folder in folders:
            posed = _read_posed(folder)
            self.held_out.append(posed[::HOLD_OUT_EVERY])
            self.for_training.append([pair for index, pair in enumerate(posed) if index % HOLD_OUT_EVERY])
            _check_enough(folder, len(self.for_training[-1]), len(self.held_out[-1]))
            if pointmaps is not None:
                for path, _ in self.for_training[-1]:
                    check_pointmap(pointmaps, path)
        self.depth_range = near, far

    def load(self, spec: SampleSpec) -> TrainingViews:
        """Neighbouring context views and targets near them, none of them held out.

        A folder with fewer images than the specification's context and targets gives fewer context views.
        """
        rng = np.random.default_rng(spec.seed)
        posed = self.for_training[rng.integers(len(self.for_training))]
        chosen = [posed[index] for index in _select(rng, posed, len(spec.target_zooms), spec.context)]
        count = len(chosen) - len(spec.target_zooms)
        return self._views(rng, chosen[:count], chosen[count:], spec)

    def load_held_out(self, spec: SampleSpec) -> TrainingViews:
        """Held-out images as targets, and the training images nearest to the first of them as context."""
        rng = np.random.default_rng(spec.seed)
        folder = int(rng.integers(len(self.held_out)))
        held_out, posed = self.held_out[folder], self.for_training[folder]
        first = int(rng.integers(len(held_out)))
        targets = [held_out[index] for index in _nearest(held_out, held_out[first])[: max(len(spec.target_zooms), 1)]]
        context = [posed[index] for index in _nearest(posed, targets[0])[: spec.context]]
        zooms = spec.target_zooms[: len(targets)]
        return self._views(rng, context, targets[: len(zooms)], replace(spec, target_zooms=zooms))

    def _views(
        self, rng: np.random.Generator, context: PosedPaths, targets: PosedPaths, spec: SampleSpec
    ) -> TrainingViews:
        batch = build_view_batch([*context, *targets], None, spec.height, spec.width)
        crops = [_load_crop(rng, pair, zoom, spec) for pair, zoom in zip(targets, spec.target_zooms, strict=True)]
        views = self._normalized(batch, len(context), crops)
        if self.pointmaps is None:
            return views
        points = [load_pointmap(self.pointmaps, *pair, spec.height, spec.width) for pair in context]
        return replace(views, pointmap=torch.from_numpy(np.concatenate(points)))

    def _normalized(self, batch: ViewBatch, context: int, targets: Sequence[tuple[Tensor, Tensor]]) -> TrainingViews:
        """The sample in the network's units. targets: images [3, H, W] and intrinsics [3, 3]."""
        found = estimate_depth_range(batch.images, batch.extrinsics, batch.intrinsics, batch.cameras, self.depth_range)
        scene = SceneNormalization.of(batch.extrinsics[:context], np.array([found.near]), self.depth_range[0])
        near, far = (torch.full((context,), depth * scene.scale) for depth in (found.near, found.far))
        poses = torch.from_numpy(scene.apply(batch.extrinsics))
        return TrainingViews(
            torch.from_numpy(batch.images[:context]),
            poses[:context],
            torch.from_numpy(batch.intrinsics[:context]),
            near,
            far,
            None,
            torch.stack([image for image, _ in targets]),
            poses[context:],
            torch.stack([intrinsics for _, intrinsics in targets]),
        )


def _load_crop(
    rng: np.random.Generator, pair: tuple[Path, Camera], zoom: int, spec: SampleSpec
) -> tuple[Tensor, Tensor]:
    """A crop [3, height, width] of an image `zoom` times as large as the context images, and its intrinsics [3, 3]."""
    view = load_view(pair, zoom * spec.height, zoom * spec.width)
    top, left = (int(rng.integers((zoom - 1) * side + 1)) for side in (spec.height, spec.width))
    image = view.image[:, top : top + spec.height, left : left + spec.width].copy()
    corner = np.array([left / spec.width, top / spec.height])
    return torch.from_numpy(image), torch.from_numpy(zoom_intrinsics(view.intrinsics, zoom, corner).astype(np.float32))


def _read_posed(folder: Path) -> PosedPaths:
    """The images that the folder's transforms.json names, with their cameras."""
    cameras = read_cameras(folder / CAMERAS)
    posed = [(folder / camera.name, camera) for camera in cameras]
    for path, _ in posed:
        if not path.is_file():
            raise InputError(f"{folder / CAMERAS}: names {path}, which is not there; add it or remove its frame")
    return posed


def _check_enough(folder: Path, training: int, held_out: int) -> None:
    if training < MIN_TRAINING_IMAGES:
        raise InputError(
            f"{folder}: {training} images to train on and {held_out} held out for validation, expected at least "
            f"{MIN_TRAINING_IMAGES} to train on; add images or leave the folder out"
        )


def _select(rng: np.random.Generator, posed: PosedPaths, targets: int, context: int) -> list[int]:
    """Indices of the context views, at most as many as there are images for, then of the target views."""
    context = min(context, len(posed) - targets)
    centres = _camera_centres(posed)
    forward = np.stack([camera.extrinsics[:3, 2] for _, camera in posed])
    chosen = [int(rng.integers(len(centres)))]
    for count in (context - 1, targets):
        rest = np.setdiff1d(np.arange(len(centres)), chosen)
        angles = np.degrees(np.arccos(np.clip((forward[rest] @ forward[chosen].T).min(axis=1), -1, 1)))
        distances = np.linalg.norm(centres[rest] - centres[chosen].mean(axis=0), axis=1)
        distances = distances * (1 + (angles / ANGLE_SCALE_DEG) ** 2)
        nearest = rest[np.argsort(distances)][: max(NEIGHBOURHOOD, count)]
        chosen += [int(index) for index in rng.choice(nearest, count, replace=False)]
    return chosen


def _nearest(posed: PosedPaths, pair: tuple[Path, Camera]) -> list[int]:
    """Indices of `posed` by distance of the camera centres from that of `pair`."""
    distances = np.linalg.norm(_camera_centres(posed) - pair[1].extrinsics[:3, 3], axis=1)
    return np.argsort(distances, kind="stable").tolist()


def _camera_centres(posed: PosedPaths) -> np.ndarray:
    """Camera centres, [images, 3]."""
    return np.stack([camera.extrinsics[:3, 3] for _, camera in posed])
