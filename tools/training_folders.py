"""Training scenes from folders of photographs: no true depth, but views to be drawn as they were taken."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..runtime.cameras import Camera, read_cameras
from ..runtime.errors import InputError
from ..runtime.views import Views as Photographs
from ..runtime.views import prepare
from .training_data import Order, Views

CAMERAS = "transforms.json"
# The other context views are drawn from this many cameras nearest to the first one, the targets from as many nearest
# to the middle of the context.
NEIGHBOURHOOD = 8


@dataclass(frozen=True)
class Folder:
    """Photographs of one scene and their cameras, with the range of depth they are trained in, in scene units."""

    pairs: list[tuple[Path, Camera]]
    near: float
    far: float


class FolderScenes:
    """Draws scenes from folders; the same order gives the same scene."""

    def __init__(self, folders: Sequence[Path], near: float, far: float) -> None:
        """Read the folders' cameras; raises InputError where cameras or photographs are missing."""
        self.folders = [Folder(_pairs(folder), near, far) for folder in folders]

    def draw(self, order: Order) -> Views:
        """Context views near each other, and targets near them; raises InputError where a scene is too small."""
        rng = np.random.default_rng(order.seed)
        folder = self.folders[rng.integers(len(self.folders))]
        chosen = _choose(rng, folder, order.context, order.targets)
        photographs = prepare([folder.pairs[index] for index in chosen], None, order.height, order.width)
        return _to_views(photographs, folder, order.context)


def _pairs(folder: Path) -> list[tuple[Path, Camera]]:
    """The photographs that the folder's transforms.json names, which lie beside it."""
    cameras = read_cameras(folder / CAMERAS)
    pairs = [(folder / camera.name, camera) for camera in cameras]
    for path, _ in pairs:
        if not path.is_file():
            raise InputError(f"{folder / CAMERAS}: names {path}, which is not there; add it or remove its frame")
    return pairs


def _choose(rng: np.random.Generator, folder: Folder, context: int, targets: int) -> list[int]:
    """Indices of context and target views."""
    places = np.stack([camera.extrinsics[:3, 3] for _, camera in folder.pairs])  # [cameras, 3]
    if len(places) < context + targets:
        found = f"{len(places)} photographs, expected at least {context + targets}"
        raise InputError(f"{folder.pairs[0][0].parent}: {found} to train on; add photographs or leave the folder out")
    chosen = [int(rng.integers(len(places)))]
    for count in (context - 1, targets):
        rest = np.setdiff1d(np.arange(len(places)), chosen)
        distances = np.linalg.norm(places[rest] - places[chosen].mean(axis=0), axis=1)
        nearest = rest[np.argsort(distances)][: max(NEIGHBOURHOOD, count)]
        chosen += [int(index) for index in rng.choice(nearest, count, replace=False)]
    return chosen


def _to_views(photographs: Photographs, folder: Folder, context: int) -> Views:
    images, extrinsics, intrinsics = (
        torch.from_numpy(part) for part in (photographs.images, photographs.extrinsics, photographs.intrinsics)
    )
    return Views(
        images[:context],
        extrinsics[:context],
        intrinsics[:context],
        torch.full((context,), folder.near),
        torch.full((context,), folder.far),
        None,
        images[context:],
        extrinsics[context:],
        intrinsics[context:],
    )
