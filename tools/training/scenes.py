"""Training scenes as tensors, drawn in the background in the order in which the steps use them."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ..synthetic.photo_textures import joined, photo_textures
from ..synthetic.sampler import TRAINING_SEEDS, Sample, generate_sample, scene_textures
from ..synthetic.textures import Textures

# Share of the scenes with three context views instead of two.
THREE_VIEW_PROBABILITY = 0.06
# Novel views are asked for as large as the photographs and, each step, a window of one up to so many times as large:
# splats that only meet views of their own size leave gaps when a viewer fills a screen with them.
MAX_TARGET_ZOOM = 4
# Scenes drawn ahead of their use.
AHEAD = 4

T = TypeVar("T")


@dataclass(frozen=True)
class Views:
    """What a network is given of a scene, and the truth."""

    images: Tensor  # [context, 3, H, W] in [0, 1]
    extrinsics: Tensor  # [context, 4, 4] camera-to-world, OpenCV axes
    intrinsics: Tensor  # [context, 3, 3] normalised by width and height
    near: Tensor  # [context]
    far: Tensor  # [context]
    inverse_depth: Tensor | None  # [context, H, W], the truth, in 1 / scene units; photographs have none
    target_images: Tensor  # [targets, 3, H, W]
    target_extrinsics: Tensor  # [targets, 4, 4]
    target_intrinsics: Tensor  # [targets, 3, 3]


@dataclass(frozen=True)
class SampleSpec:
    """One scene as a step wants it.

    target_zooms: each target is a random crop of an image that many times as large as the context images.
    real: whether the views are those of a capture, where a run has both kinds.
    """

    seed: int
    context: int
    target_zooms: tuple[int, ...]
    height: int
    width: int
    real: bool = False


def to_views(sample: Sample) -> Views:
    """A procedural sample as tensors."""
    count = sample.context
    images, extrinsics, intrinsics = (
        torch.from_numpy(part) for part in (sample.images, sample.extrinsics, sample.intrinsics)
    )
    return Views(
        images[:count],
        extrinsics[:count],
        intrinsics[:count],
        torch.full((count,), sample.near),
        torch.full((count,), sample.far),
        1 / torch.from_numpy(sample.depth[:count]),
        images[count:],
        extrinsics[count:],
        intrinsics[count:],
    )


def generate_views(spec: SampleSpec, photos: Path | None = None) -> Views:
    """The scene of an order; the same order gives the same scene.

    photos: a folder of images for the textures of training scenes, beside the generated ones.
    """
    bank = _with_photos(photos) if photos is not None and spec.seed in TRAINING_SEEDS else None
    zooms = spec.target_zooms
    return to_views(
        generate_sample(spec.seed, spec.context, len(zooms), spec.height, spec.width, target_zooms=zooms, bank=bank)
    )


@cache
def _with_photos(folder: Path) -> Textures:
    """The textures of training scenes, and those of a folder."""
    return joined(scene_textures(TRAINING_SEEDS.start), photo_textures(folder))


def training_spec(
    seed: int, step: int, slot: int, rendered: bool, height: int, width: int, many: bool, real_ratio: float = 0.0
) -> SampleSpec:
    """The scene at place `slot` of a step's batch, drawn from the run's seed and the step alone.

    rendered: whether it has novel views. many: whether some scenes are to have three context views.
    real_ratio: share of the scenes that are captures.
    """
    rng = np.random.default_rng((seed, step, slot))
    context = 3 if many and rng.random() < THREE_VIEW_PROBABILITY else 2
    scene = int(rng.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop))
    target_zooms = (1, int(rng.integers(2, MAX_TARGET_ZOOM + 1))) if rendered else ()
    return SampleSpec(scene, context, target_zooms, height, width, real=bool(rng.random() < real_ratio))


def prefetch(specs: Iterator[SampleSpec], load: Callable[[SampleSpec], T]) -> Generator[T]:
    """The scenes of `specs`, in that order, drawn by a thread while the caller is at work."""
    with ThreadPoolExecutor(1, thread_name_prefix="scenes") as pool:
        waiting: deque[Future[T]] = deque()
        try:
            for spec in specs:
                waiting.append(pool.submit(load, spec))
                if len(waiting) > AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
