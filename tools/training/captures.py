"""Training scenes from folders of photographs: no true depth, but views to be drawn as they were taken.

Every eighth photograph of a folder, from the first one in the order of its transforms.json, is held out: validation
renders these from the others, and training uses none of them.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ...runtime.cameras.camera import Camera
from ...runtime.cameras.io import read_cameras
from ...runtime.errors import InputError
from ...runtime.inference.normalization import SceneNormalization
from ...runtime.views.batch import ViewBatch, build_view_batch
from ...runtime.views.depth_range import estimate_depth_range
from ...runtime.views.loader import load_view
from ..synthetic.sampler import crop_intrinsics
from .scenes import SampleSpec, Views

CAMERAS = "transforms.json"
# The other context views are drawn from this many cameras nearest to the first one, the targets from as many nearest
# to the middle of the context.
NEIGHBOURHOOD = 4
# A camera that looks this much elsewhere counts as standing twice as far away.
TURN_DEG = 30.0
# One of so many photographs is held out, from the first, as in the published splits of such captures.
HOLD_OUT_EVERY = 8
FEWEST_CONTEXT, FEWEST_TARGETS = 2, 2

Pairs = list[tuple[Path, Camera]]


class FolderScenes:
    """Draws scenes from folders; the same order gives the same scene.

    for_training, held_out: the photographs of each folder with their cameras.
    """

    def __init__(self, folders: Sequence[Path], near: float, far: float) -> None:
        """Read the folders' cameras; raises InputError where cameras or photographs are missing, or too few.

        near, far: what the network is trained for. As where it is used, scenes come in the unit that has this near.
        """
        self.for_training: list[Pairs] = []
        self.held_out: list[Pairs] = []
        for folder in folders:
            pairs = _pairs(folder)
            self.held_out.append(pairs[::HOLD_OUT_EVERY])
            self.for_training.append([pair for index, pair in enumerate(pairs) if index % HOLD_OUT_EVERY])
            _check_enough(folder, len(self.for_training[-1]), len(self.held_out[-1]))
        self.trained = near, far

    def load(self, spec: SampleSpec) -> Views:
        """Context views near each other, and targets near them, none of them held out.

        A folder with too few photographs for the order's targets and context gives fewer context views.
        """
        rng = np.random.default_rng(spec.seed)
        pairs = self.for_training[rng.integers(len(self.for_training))]
        chosen = _choose(rng, pairs, len(spec.target_zooms), spec.context)
        count = len(chosen) - len(spec.target_zooms)
        return self._views(rng, [pairs[index] for index in chosen[:count]], [pairs[i] for i in chosen[count:]], spec)

    def load_held_out(self, spec: SampleSpec) -> Views:
        """Held-out photographs as targets, and those for training that were taken nearest to them as context."""
        rng = np.random.default_rng(spec.seed)
        folder = int(rng.integers(len(self.held_out)))
        held_out, pairs = self.held_out[folder], self.for_training[folder]
        first = int(rng.integers(len(held_out)))
        targets = [held_out[index] for index in _nearest(held_out, held_out[first])[: max(len(spec.target_zooms), 1)]]
        context = [pairs[index] for index in _nearest(pairs, targets[0])[: spec.context]]
        target_zooms = spec.target_zooms[: len(targets)]
        return self._views(rng, context, targets[: len(target_zooms)], replace(spec, target_zooms=target_zooms))

    def _views(self, rng: np.random.Generator, context: Pairs, targets: Pairs, spec: SampleSpec) -> Views:
        photographs = build_view_batch([*context, *targets], None, spec.height, spec.width)
        windows = [_target(rng, pair, zoom, spec) for pair, zoom in zip(targets, spec.target_zooms, strict=True)]
        return self._to_views(photographs, len(context), windows)

    def _to_views(self, photographs: ViewBatch, context: int, targets: Sequence[tuple[Tensor, Tensor]]) -> Views:
        given = photographs.images, photographs.extrinsics, photographs.intrinsics
        found = estimate_depth_range(*given, photographs.cameras, self.trained)
        frame = SceneNormalization.of(photographs.extrinsics[:context], np.array([found.near]), self.trained[0])
        near, far = (torch.full((context,), depth * frame.scale) for depth in (found.near, found.far))
        poses = torch.from_numpy(frame.apply(photographs.extrinsics))
        return Views(
            torch.from_numpy(photographs.images[:context]),
            poses[:context],
            torch.from_numpy(photographs.intrinsics[:context]),
            near,
            far,
            None,
            torch.stack([image for image, _ in targets]),
            poses[context:],
            torch.stack([intrinsics for _, intrinsics in targets]),
        )


def _target(rng: np.random.Generator, pair: tuple[Path, Camera], zoom: int, spec: SampleSpec) -> tuple[Tensor, Tensor]:
    """A crop [3, height, width] of an image `zoom` times as large as the context images, and its intrinsics [3, 3]."""
    view = load_view(pair, zoom * spec.height, zoom * spec.width)
    top, left = (int(rng.integers((zoom - 1) * side + 1)) for side in (spec.height, spec.width))
    image = view.image[:, top : top + spec.height, left : left + spec.width].copy()
    corner = np.array([left / spec.width, top / spec.height])
    return torch.from_numpy(image), torch.from_numpy(crop_intrinsics(view.intrinsics, zoom, corner).astype(np.float32))


def _pairs(folder: Path) -> Pairs:
    """The photographs that the folder's transforms.json names, which lie beside it."""
    cameras = read_cameras(folder / CAMERAS)
    pairs = [(folder / camera.name, camera) for camera in cameras]
    for path, _ in pairs:
        if not path.is_file():
            raise InputError(f"{folder / CAMERAS}: names {path}, which is not there; add it or remove its frame")
    return pairs


def _check_enough(folder: Path, training: int, held_out: int) -> None:
    if training < FEWEST_CONTEXT + FEWEST_TARGETS:
        raise InputError(
            f"{folder}: {training} photographs to train on and {held_out} held out for validation, expected at least "
            f"{FEWEST_CONTEXT + FEWEST_TARGETS} to train on; add photographs or leave the folder out"
        )


def _choose(rng: np.random.Generator, pairs: Pairs, targets: int, context: int) -> list[int]:
    """Indices of context views, as many as there are photographs for, and then of target views."""
    context = min(context, len(pairs) - targets)
    places = _places(pairs)
    forward = np.stack([camera.extrinsics[:3, 2] for _, camera in pairs])
    chosen = [int(rng.integers(len(places)))]
    for count in (context - 1, targets):
        rest = np.setdiff1d(np.arange(len(places)), chosen)
        turns = np.degrees(np.arccos(np.clip((forward[rest] @ forward[chosen].T).min(axis=1), -1, 1)))
        distances = np.linalg.norm(places[rest] - places[chosen].mean(axis=0), axis=1) * (1 + (turns / TURN_DEG) ** 2)
        nearest = rest[np.argsort(distances)][: max(NEIGHBOURHOOD, count)]
        chosen += [int(index) for index in rng.choice(nearest, count, replace=False)]
    return chosen


def _nearest(pairs: Pairs, pair: tuple[Path, Camera]) -> list[int]:
    """Indices of pairs, those taken nearest to a photograph first."""
    return np.argsort(np.linalg.norm(_places(pairs) - pair[1].extrinsics[:3, 3], axis=1), kind="stable").tolist()


def _places(pairs: Pairs) -> np.ndarray:
    """Where the cameras stand, [cameras, 3]."""
    return np.stack([camera.extrinsics[:3, 3] for _, camera in pairs])
