"""Training scenes from folders of photographs: no true depth, but views to be drawn as they were taken."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..runtime.cameras import Camera, read_cameras
from ..runtime.depth_range import find_depth_range
from ..runtime.errors import InputError
from ..runtime.scene_frame import SceneFrame
from ..runtime.views import Views as Photographs
from ..runtime.views import prepare, take
from .scenes import window
from .training_data import Order, Views

CAMERAS = "transforms.json"
# The other context views are drawn from this many cameras nearest to the first one, the targets from as many nearest
# to the middle of the context.
NEIGHBOURHOOD = 4
# A camera that looks this much elsewhere counts as standing twice as far away.
TURN_DEG = 30.0


Pairs = list[tuple[Path, Camera]]


class FolderScenes:
    """Draws scenes from folders; the same order gives the same scene."""

    def __init__(self, folders: Sequence[Path], near: float, far: float) -> None:
        """Read the folders' cameras; raises InputError where cameras or photographs are missing.

        near, far: what the network is trained for. As where it is used, scenes come in the unit that has this near.
        """
        self.folders = [_pairs(folder) for folder in folders]
        self.trained = near, far

    def draw(self, order: Order) -> Views:
        """Context views near each other, and targets near them; raises InputError where a scene is too small."""
        rng = np.random.default_rng(order.seed)
        pairs = self.folders[rng.integers(len(self.folders))]
        chosen = _choose(rng, pairs, order.context, len(order.closer))
        photographs = prepare([pairs[index] for index in chosen], None, order.height, order.width)
        targets = [
            _target(rng, pairs[index], closer, order)
            for index, closer in zip(chosen[order.context :], order.closer, strict=True)
        ]
        return self._to_views(photographs, order.context, targets)

    def _to_views(self, photographs: Photographs, context: int, targets: Sequence[tuple[Tensor, Tensor]]) -> Views:
        given = photographs.images, photographs.extrinsics, photographs.intrinsics
        found = find_depth_range(*given, photographs.cameras, self.trained)
        frame = SceneFrame.of(photographs.extrinsics[:context], np.array([found.near]), self.trained[0])
        near, far = (torch.full((context,), depth * frame.scale) for depth in (found.near, found.far))
        poses = torch.from_numpy(frame.enter(photographs.extrinsics))
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


def _target(rng: np.random.Generator, pair: tuple[Path, Camera], closer: int, order: Order) -> tuple[Tensor, Tensor]:
    """A window [3, height, width] of a photograph `closer` times as large as the context, and its intrinsics [3, 3]."""
    large, intrinsics, _ = take(pair, closer * order.height, closer * order.width)
    top, left = (int(rng.integers((closer - 1) * side + 1)) for side in (order.height, order.width))
    image = large[:, top : top + order.height, left : left + order.width].copy()
    corner = np.array([left / order.width, top / order.height])
    return torch.from_numpy(image), torch.from_numpy(window(intrinsics, closer, corner).astype(np.float32))


def _pairs(folder: Path) -> Pairs:
    """The photographs that the folder's transforms.json names, which lie beside it."""
    cameras = read_cameras(folder / CAMERAS)
    pairs = [(folder / camera.name, camera) for camera in cameras]
    for path, _ in pairs:
        if not path.is_file():
            raise InputError(f"{folder / CAMERAS}: names {path}, which is not there; add it or remove its frame")
    return pairs


def _choose(rng: np.random.Generator, pairs: Pairs, context: int, targets: int) -> list[int]:
    """Indices of context and target views."""
    poses = np.stack([camera.extrinsics for _, camera in pairs])  # [cameras, 4, 4]
    places, forward = poses[:, :3, 3], poses[:, :3, 2]
    if len(places) < context + targets:
        found = f"{len(places)} photographs, expected at least {context + targets}"
        raise InputError(f"{pairs[0][0].parent}: {found} to train on; add photographs or leave the folder out")
    chosen = [int(rng.integers(len(places)))]
    for count in (context - 1, targets):
        rest = np.setdiff1d(np.arange(len(places)), chosen)
        turns = np.degrees(np.arccos(np.clip((forward[rest] @ forward[chosen].T).min(axis=1), -1, 1)))
        distances = np.linalg.norm(places[rest] - places[chosen].mean(axis=0), axis=1) * (1 + (turns / TURN_DEG) ** 2)
        nearest = rest[np.argsort(distances)][: max(NEIGHBOURHOOD, count)]
        chosen += [int(index) for index in rng.choice(nearest, count, replace=False)]
    return chosen
