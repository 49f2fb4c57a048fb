"""Training samples of synthetic scenes, with exact depth."""

from functools import cache
from pathlib import Path

import numpy as np
import torch

from ...synthetic.photo_textures import concatenate, photo_textures
from ...synthetic.sampler import TRAINING_SEEDS, Sample, generate_sample, scene_textures
from ...synthetic.textures import Textures
from ..options import TARGET_ZOOM
from .samples import SampleSpec, TrainingViews

# Numbers of context views once there is more than one DPBU, and their probabilities.
VIEW_COUNT_PROBABILITIES = {2: 0.85, 3: 0.07, 4: 0.05, 6: 0.03}
# Images of more views are smaller, so that a scene of six takes no more memory than one of four: their side is this
# share of that of other scenes, in multiples that every network takes.
MANY_VIEWS, MANY_VIEWS_SIDE, SIDE_MULTIPLE = 5, 0.75, 32


def sample_view_count(rng: np.random.Generator, probabilities: dict[int, float]) -> int:
    """A random number of context views. probabilities: by number."""
    return int(rng.choice(list(probabilities), p=list(probabilities.values())))


def sample_target_zooms(rng: np.random.Generator, largest: int) -> tuple[int, int]:
    """The zooms of the two target views: 1, and a random one from 2 to `largest`, or 1 if that is the largest."""
    return 1, int(rng.integers(min(2, largest), largest + 1))


def training_spec(
    seed: int,
    step: int,
    slot: int,
    rendered: bool,
    height: int,
    width: int,
    more_views: bool,
    real_ratio: float = 0.0,
    target_zoom: int = TARGET_ZOOM,
) -> SampleSpec:
    """The sample at place `slot` of a step's batch, which depends on the run's seed and the step alone.

    rendered: whether it has target views. height, width: in pixels, of scenes with fewer than MANY_VIEWS context views.
    more_views: whether some samples have more than two context views. real_ratio: probability of a capture.
    target_zoom: the largest zoom of a target view.
    """
    # All scenes of a step have the same number of views, so that no process waits for another.
    of_step, rng = np.random.default_rng((seed, step)), np.random.default_rng((seed, step, slot))
    context = sample_view_count(of_step, VIEW_COUNT_PROBABILITIES)
    scene = int(rng.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop))
    zooms = sample_target_zooms(rng, target_zoom) if rendered else ()
    real = bool(rng.random() < real_ratio)
    if not more_views:
        return SampleSpec(scene, 2, zooms, height, width, real=real)
    if context >= MANY_VIEWS:
        height, width = (_smaller_side(side) for side in (height, width))
    return SampleSpec(scene, context, zooms, height, width, real=real)


def _smaller_side(side: int) -> int:
    """The side of images of many views, in pixels."""
    return max(int(MANY_VIEWS_SIDE * side) // SIDE_MULTIPLE, 1) * SIDE_MULTIPLE


def generate_views(spec: SampleSpec, photos: Path | None = None) -> TrainingViews:
    """The synthetic sample of a specification.

    photos: folder of images for the textures of training scenes, in addition to the generated textures.
    """
    textures = _with_photos(photos) if photos is not None and spec.seed in TRAINING_SEEDS else None
    zooms = spec.target_zooms
    sample = generate_sample(
        spec.seed, spec.context, len(zooms), spec.height, spec.width, target_zooms=zooms, textures=textures
    )
    return to_views(sample)


def to_views(sample: Sample) -> TrainingViews:
    """A synthetic sample as tensors."""
    count = sample.context
    images, extrinsics, intrinsics = (
        torch.from_numpy(part) for part in (sample.images, sample.extrinsics, sample.intrinsics)
    )
    return TrainingViews(
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


@cache
def _with_photos(folder: Path) -> Textures:
    """The generated textures of training scenes, and those of a folder."""
    return concatenate(scene_textures(TRAINING_SEEDS.start), photo_textures(folder))
