"""Samples for training and evaluation: views of a synthetic scene with exact depth and cameras, from a seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .layout import generate_layout
from .placement import HELD_OUT_PLACEMENT, TRAINING_PLACEMENT, sample_intrinsics, sample_poses
from .textures import Textures, texture_bank
from .views import render, zoom_intrinsics

# Results are reported on the held-out seeds alone; settings are chosen on the validation seeds. Training scenes share
# no textures with either.
TRAINING_SEEDS = range(0, 1_000_000_000)
VALIDATION_SEEDS = range(1_000_000_000, 1_000_000_100)
HELD_OUT_SEEDS = range(1_000_001_000, 1_000_001_200)

# Share of the samples whose depth range is far wider than the scene, and the largest ratio of far to near there, and in
# training anywhere.
WIDE_RANGE_PROBABILITY = 0.25
MAX_DEPTH_RATIO = 200.0


@dataclass(frozen=True)
class CameraVariation:
    """How the views of a capture differ: relative ranges of exposure and channel gains; shares of JPEG and of moved."""

    exposure: float
    white_balance: float
    jpeg: float
    moved: float


# For training scenes, and for validation and held-out scenes.
TRAINING_VARIATION, HELD_OUT_VARIATION = CameraVariation(0.08, 0.03, 0.5, 0.1), CameraVariation(0.05, 0.0, 0.0, 0.0)
JPEG_QUALITY = (60, 98)
MOTION = (1.0, 3.5)  # length of motion blur in pixels


@dataclass(frozen=True)
class Sample:
    """Views of one scene: first the context views, the input of a network, then the target views.

    Context images have the exposure, blur and noise of a camera; target images have not.

    images: [views, 3, height, width] float32 in [0, 1].
    depth: exact z-depth at the pixel centres in scene units, at most far, [views, height, width] float32.
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4] float32.
    intrinsics: normalised, row 0 divided by the width, row 1 by the height, [views, 3, 3] float32.
    near, far: bounds of all depths, in scene units; far is at most MAX_DEPTH_RATIO times near in training.
    context: number of context views.
    """

    images: np.ndarray
    depth: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    near: float
    far: float
    context: int


def scene_textures(seed: int) -> Textures:
    """The textures of the scene of `seed`: one bank for training, another for validation and held-out scenes."""
    return texture_bank(1, 260) if seed in TRAINING_SEEDS else texture_bank(2, 104)


def generate_sample(
    seed: int,
    context: int,
    targets: int,
    height: int,
    width: int,
    samples: int = 4,
    target_zooms: Sequence[int] = (),
    textures: Textures | None = None,
) -> Sample:
    """The sample of `seed`: `context` overlapping views along a path, and `targets` views between and around them.

    The same arguments give the same sample. samples: rays per pixel. target_zooms: each
    target is a random crop of an image rendered that many times as large as the context images; if empty, all are 1.
    textures: by default `scene_textures(seed)`. The first call in a process generates them, which takes seconds.
    """
    rng = np.random.default_rng(seed)
    training = seed in TRAINING_SEEDS
    textures = textures or scene_textures(seed)
    layout = generate_layout(rng, textures, training=training)
    placement = TRAINING_PLACEMENT if training else HELD_OUT_PLACEMENT
    intrinsics = sample_intrinsics(rng, context + targets, width / height, placement)
    extrinsics = sample_poses(rng, layout, intrinsics, context, targets, placement)
    for view, zoom in enumerate(target_zooms, start=context):
        if zoom > 1:
            intrinsics[view] = zoom_intrinsics(intrinsics[view], zoom, rng.uniform(0, zoom - 1, 2))
    views = [
        render(layout.scene, textures, pose, k, height, width, samples)
        for pose, k in zip(extrinsics, intrinsics, strict=True)
    ]
    depth = np.stack([view_depth for _, view_depth in views])
    scale, near, far = _sample_depth_range(rng, depth)
    if training:  # a sky, which at inference counts as far, too
        far = min(far, MAX_DEPTH_RATIO * near)
    extrinsics[:, :3, 3] *= scale
    brightness = float(np.mean([image.mean() for image, _ in views]))
    exposure = np.float32(np.clip(rng.uniform(0.33, 0.52) / max(brightness, 1e-3), 0.6, 2.5))
    variation = TRAINING_VARIATION if training else HELD_OUT_VARIATION
    images = [
        _simulate_camera(rng, image * exposure, index < context, variation) for index, (image, _) in enumerate(views)
    ]
    return Sample(
        np.stack(images).transpose(0, 3, 1, 2).copy(),
        np.minimum(depth * np.float32(scale), np.float32(far)),
        extrinsics.astype(np.float32),
        intrinsics.astype(np.float32),
        near,
        far,
        context,
    )


def _sample_depth_range(rng: np.random.Generator, depth: np.ndarray) -> tuple[float, float, float]:
    """The factor from metres to scene units, in which near is 1; then near and far in scene units."""
    near = float(depth.min()) * rng.uniform(0.5, 0.95)
    far = float(depth.max()) * rng.uniform(1.05, 2.0)
    if rng.random() < WIDE_RANGE_PROBABILITY:  # as if nothing were known of the scene
        near *= rng.uniform(0.3, 1.0)
        far = max(far, near * np.exp(rng.uniform(np.log(10.0), np.log(MAX_DEPTH_RATIO))))
    return 1 / near, 1.0, far / near


def _simulate_camera(
    rng: np.random.Generator, image: np.ndarray, degrade: bool, variation: CameraVariation
) -> np.ndarray:
    """The clipped image [height, width, 3]; `degrade` adds random exposure, white balance, blurs, noise, JPEG."""
    if degrade:
        image = image * np.float32(rng.uniform(1 - variation.exposure, 1 + variation.exposure))
        if variation.white_balance:
            image = image * rng.uniform(1 - variation.white_balance, 1 + variation.white_balance, 3).astype(np.float32)
        blur = rng.uniform(-0.5, 0.8)  # pixels
        if blur > 0.25:
            image = cv2.GaussianBlur(image, (5, 5), blur)
        if variation.moved and rng.random() < variation.moved:
            image = cv2.filter2D(image, -1, _motion_kernel(rng.uniform(*MOTION), rng.uniform(0, np.pi)))
        image = image + np.float32(max(rng.uniform(-0.01, 0.02), 0)) * rng.standard_normal(image.shape, np.float32)
    image = image.clip(0, 1).astype(np.float32)
    if degrade and variation.jpeg and rng.random() < variation.jpeg:
        quality = int(rng.integers(*JPEG_QUALITY))
        _, coded = cv2.imencode(".jpg", np.rint(255 * image).astype(np.uint8), (cv2.IMWRITE_JPEG_QUALITY, quality))
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.float32) / 255
    return image


def _motion_kernel(length: float, angle: float) -> np.ndarray:
    """The blur of an image that moves by `length` pixels along a line, an odd square that sums to 1."""
    reach = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for place in np.linspace(-length / 2, length / 2, 8 * reach):
        x, y = reach + place * np.cos(angle), reach + place * np.sin(angle)
        column, row = int(x), int(y)
        weights = np.outer((1 - y + row, y - row), (1 - x + column, x - column))  # bilinear
        kernel[row : row + 2, column : column + 2] += weights
    return (kernel / kernel.sum()).astype(np.float32)
