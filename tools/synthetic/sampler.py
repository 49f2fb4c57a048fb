"""Samples for training and evaluation: views of a synthetic scene with exact depth and cameras, from a seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...runtime.geometry.intrinsics import crop_intrinsics, denormalize_intrinsics, scale_intrinsics
from ...runtime.geometry.rigid import invert_rigid, transform_points
from .layout import Layout, generate_layout
from .raycast import Scene, cast_rays
from .textures import Textures, texture_bank

# Results are reported on the held-out seeds alone; settings are chosen on the validation seeds. Training scenes share
# no textures with either.
TRAINING_SEEDS = range(0, 1_000_000_000)
VALIDATION_SEEDS = range(1_000_000_000, 1_000_000_100)
HELD_OUT_SEEDS = range(1_000_001_000, 1_000_001_200)

# Share of the samples whose depth range is far wider than the scene, and the largest ratio of far to near there.
WIDE_RANGE_PROBABILITY = 0.25
MAX_DEPTH_RATIO = 200.0
# Side in pixels of the small depth map from which a camera pose is scored.
PROBE = 24
# Random camera placements that are tried; the first is taken in which every other view sees this share of the points of
# the first view.
MAX_ATTEMPTS, MIN_OVERLAP = 60, 0.6


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
    depth: exact z-depth at the pixel centres in scene units, [views, height, width] float32.
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4] float32.
    intrinsics: normalised, row 0 divided by the width, row 1 by the height, [views, 3, 3] float32.
    near, far: bounds of all depths, in scene units.
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
    intrinsics = _sample_intrinsics(rng, context + targets, width / height)
    extrinsics = _sample_poses(rng, layout, intrinsics, context, targets)
    for view, zoom in enumerate(target_zooms, start=context):
        if zoom > 1:
            intrinsics[view] = zoom_intrinsics(intrinsics[view], zoom, rng.uniform(0, zoom - 1, 2))
    views = [
        render(layout.scene, textures, pose, k, height, width, samples)
        for pose, k in zip(extrinsics, intrinsics, strict=True)
    ]
    depth = np.stack([view_depth for _, view_depth in views])
    scale, near, far = _sample_depth_range(rng, depth)
    extrinsics[:, :3, 3] *= scale
    brightness = float(np.mean([image.mean() for image, _ in views]))
    exposure = np.float32(np.clip(rng.uniform(0.33, 0.52) / max(brightness, 1e-3), 0.6, 2.5))
    variation = TRAINING_VARIATION if training else HELD_OUT_VARIATION
    images = [
        _simulate_camera(rng, image * exposure, index < context, variation) for index, (image, _) in enumerate(views)
    ]
    return Sample(
        np.stack(images).transpose(0, 3, 1, 2).copy(),
        depth * np.float32(scale),
        extrinsics.astype(np.float32),
        intrinsics.astype(np.float32),
        near,
        far,
        context,
    )


def render(
    scene: Scene, textures: Textures, pose: np.ndarray, intrinsics: np.ndarray, height: int, width: int, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colour [height, width, 3], in which 1 is white and values may be larger, and z-depth [height, width], float32.

    pose: camera-to-world, OpenCV axes, [4, 4]. intrinsics: normalised, [3, 3]. samples: rays per pixel (0: the image is
    black). Depth is that at the pixel's centre.
    """
    image, depth = np.zeros((height, width, 3), np.float32), np.empty((height, width), np.float32)
    (fx, _, cx), (_, fy, cy) = denormalize_intrinsics(intrinsics, width, height)[:2]
    cast_rays(scene, textures.texels, pose, (fx, fy, cx, cy), _pixel_offsets(samples), image, depth)
    return image, depth


def look_at(eye: np.ndarray, focus: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Camera-to-world pose [4, 4] at `eye`, looking at `focus`. roll: about the optical axis, in radians; y is down."""
    forward = (focus - eye) / np.linalg.norm(focus - eye)
    right = np.array([forward[2], 0.0, -forward[0]]) / np.hypot(forward[0], forward[2])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2] = forward
    pose[:3, 3] = eye
    return pose


def zoom_intrinsics(intrinsics: np.ndarray, zoom: int, corner: np.ndarray) -> np.ndarray:
    """Normalised intrinsics [3, 3] of a crop of an image that is rendered `zoom` times as large.

    corner: the crop's upper left corner [2], in units of the crop's size.
    """
    return crop_intrinsics(scale_intrinsics(intrinsics, zoom, zoom), *corner)


def probe(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """A small depth map [PROBE, PROBE]; all zeros if the camera is outside the enclosing solid."""
    bare = Textures(np.zeros((1, 1, 3), np.uint8), ())
    _, depth = render(scene, bare, pose, intrinsics, PROBE, PROBE, 0)
    return depth if np.isfinite(depth).all() else np.zeros_like(depth)


def depth_edge_share(seen: np.ndarray) -> float:
    """The share of horizontally neighbouring depths of a probe that differ by more than about 10 %."""
    return float((np.abs(np.diff(np.log(seen), axis=1)) > 0.1).mean())


def _pixel_offsets(samples: int) -> np.ndarray:
    """Positions inside a pixel, [samples, 2]: a Hammersley point set."""
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(16)) & 1
    radical_inverse = bits @ 0.5 ** np.arange(1, 17)
    return np.stack([(index + 0.5) / max(samples, 1), radical_inverse + 0.5 / max(samples, 1)], axis=-1)


def _sample_intrinsics(rng: np.random.Generator, views: int, aspect: float) -> np.ndarray:
    """Random normalised intrinsics [views, 3, 3], the same for all views or, in some samples, slightly different."""
    field_of_view = np.exp(rng.uniform(np.log(35), np.log(85)))  # degrees, of the longer side
    focal = 0.5 / np.tan(np.radians(field_of_view) / 2)
    zoom = np.exp(rng.normal(0, 0.05, views) * (rng.random() < 0.2))
    stretch = np.exp(rng.normal(0, 0.01))
    intrinsics = np.zeros((views, 3, 3))
    intrinsics[:, 0, 0] = focal * zoom * max(1 / aspect, 1.0)
    intrinsics[:, 1, 1] = focal * zoom * max(aspect, 1.0) * stretch
    intrinsics[:, :2, 2] = 0.5 + rng.normal(0, 0.02, 2)
    intrinsics[:, 2, 2] = 1
    return intrinsics


def _sample_poses(
    rng: np.random.Generator, layout: Layout, intrinsics: np.ndarray, context: int, targets: int
) -> np.ndarray:
    """Poses [views, 4, 4] outside the solids whose views overlap; the best that was found in MAX_ATTEMPTS."""
    best, best_score = np.empty(0), 0.0
    for _ in range(MAX_ATTEMPTS):
        first = look_at(rng.uniform(*layout.eye_bounds), rng.uniform(*layout.focus_bounds), rng.normal(0, 0.06))
        seen = probe(layout.scene, first, intrinsics[0])
        if seen.min() <= 0.2 * np.median(seen):  # inside a solid, or close to one
            continue
        if depth_edge_share(seen) < 0.02 and rng.random() < 0.8:  # only flat walls, which are kept in some samples
            continue
        poses = _sample_neighbour_poses(rng, first, float(np.median(seen)), context, targets)
        score = min((_overlap(layout.scene, poses, intrinsics, seen, i) for i in range(1, len(poses))), default=1.0)
        if score > best_score:
            best, best_score = poses, score
        if score > MIN_OVERLAP:
            break
    if best_score == 0.0:  # all blocked: a row of cameras, close together, at the centre of the bounds
        first = look_at(layout.eye_bounds.mean(axis=0), layout.focus_bounds[1])
        best = np.stack([first] * (context + targets))
        best[:, :3, 3] += 0.01 * np.arange(context + targets)[:, None] * first[:3, 0]
    return best


def _sample_neighbour_poses(
    rng: np.random.Generator, first: np.ndarray, distance: float, context: int, targets: int
) -> np.ndarray:
    """Context poses along a path from `first`, 3 to 30 % of `distance` apart, and targets between and around them."""
    baseline = np.exp(rng.uniform(np.log(0.03), np.log(0.3))) * distance
    spread = baseline * min(context - 1, 3)  # from the first to the last
    heading = first[:3, :3] @ (rng.normal(0, 1, 3) * (1.0, 0.35, 0.35))
    heading /= np.linalg.norm(heading)
    steps = np.linspace(0, 1, context) + rng.normal(0, 0.1, context) / max(context - 1, 1)
    between = rng.uniform(-0.25, 1.25, targets)
    wander = rng.normal(0, 0.08, (context + targets, 3))
    eyes = first[:3, 3] + spread * (np.append(steps, between)[:, None] * heading + wander)
    focus = first[:3, 3] + distance * rng.uniform(0.8, 3.0) * first[:3, 2]
    roll = rng.normal(0, 0.04, len(eyes))
    turn = rng.normal(0, 0.04 * distance, (len(eyes), 3))
    poses = np.stack([look_at(eye, focus + shift, tilt) for eye, shift, tilt in zip(eyes, turn, roll, strict=True)])
    poses[0] = first
    return poses


def _overlap(scene: Scene, poses: np.ndarray, intrinsics: np.ndarray, seen: np.ndarray, view: int) -> float:
    """The share of the first view's points (depths `seen`) that project into view `view`; -1 if that is blocked."""
    depth = probe(scene, poses[view], intrinsics[view])
    if depth.min() <= 0.12 * np.median(depth) or not 0.4 < np.median(depth) / np.median(seen) < 2.5:
        return -1.0
    centres = (np.arange(PROBE) + 0.5) / PROBE
    pixels = np.stack([*np.meshgrid(centres, centres), np.ones((PROBE, PROBE))], axis=-1)
    points = pixels @ np.linalg.inv(intrinsics[0]).T * seen[..., None]
    relative = invert_rigid(poses[view]) @ poses[0]
    projected = transform_points(relative, points) @ intrinsics[view].T
    uv = projected[..., :2] / np.maximum(projected[..., 2:], 1e-6)
    return float(((uv > 0) & (uv < 1)).all(axis=-1).mean())


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
