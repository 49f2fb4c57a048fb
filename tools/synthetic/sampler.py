"""Training and evaluation samples drawn from a seed: photographs of procedural scenes with exact depth and cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from .layout import Layout, generate_layout
from .raycast import Scene, cast_rays
from .textures import Textures, texture_bank

# Results are reported on the held-out seeds alone; settings are chosen on the validation seeds. Neither's textures
# cover any training scene.
TRAINING_SEEDS = range(0, 1_000_000_000)
VALIDATION_SEEDS = range(1_000_000_000, 1_000_000_100)
HELD_OUT_SEEDS = range(1_000_001_000, 1_000_001_200)

# Share of the samples whose depth range is far wider than the scene, and the largest ratio of far to near there.
WIDE_RANGE_PROBABILITY = 0.25
WIDEST = 200.0
PROBE = 24  # pixels: the small depth map by which a camera is judged
ATTEMPTS = 60  # to place the cameras of a sample
GOOD_OVERLAP = 0.6  # share of the first view's points that each other view should see


@dataclass(frozen=True)
class CameraVariation:
    """How far the views of a capture differ, as shares: exposure, white balance; and how many are JPEG files."""

    exposure: float
    white_balance: float
    compressed: float


# Of training scenes, and of those that results are reported on.
TRAINING_VARIATION, HELD_OUT_VARIATION = CameraVariation(0.08, 0.03, 0.5), CameraVariation(0.05, 0.0, 0.0)
JPEG_QUALITY = (60, 98)


@dataclass(frozen=True)
class Sample:
    """Views of one scene: first the context views, which a network sees, then the target views, which it is to render.

    Context images have the exposure, blur and noise of a camera; target images are clean.

    images: [views, 3, height, width] float32 in [0, 1].
    depth: exact z-depth at the pixel centres in scene units, [views, height, width] float32.
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4] float32.
    intrinsics: row 0 divided by the width, row 1 by the height, [views, 3, 3] float32.
    near, far: bounds of every depth, in scene units.
    context: how many of the views are context.
    """

    images: np.ndarray
    depth: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    near: float
    far: float
    context: int


def scene_textures(seed: int) -> Textures:
    """The textures of the scene that `seed` draws: one bank for training, another for everything reported."""
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
    """The sample of `seed`: `context` views whose neighbours overlap, and `targets` views between and around them.

    The same arguments give the same sample. samples: rays for a pixel's colour. target_zooms: each
    target is a random crop of an image rendered that many times as large as the context images; if empty, all are 1.
    bank: textures instead of `scene_textures(seed)`.
    The first call in a process draws the textures (some seconds).
    """
    rng = np.random.default_rng(seed)
    training = seed in TRAINING_SEEDS
    textures = textures or scene_textures(seed)
    layout = generate_layout(rng, textures, outdoors=training)
    intrinsics = _sample_intrinsics(rng, context + targets, width / height)
    extrinsics = _sample_poses(rng, layout, intrinsics, context, targets)
    for view, zoom in enumerate(target_zooms, start=context):
        if zoom > 1:
            intrinsics[view] = crop_intrinsics(intrinsics[view], zoom, rng.uniform(0, zoom - 1, 2))
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
    """Colour [height, width, 3], from 0, 1 for white, and z-depth [height, width] of a scene, both float32.

    pose: camera-to-world, OpenCV axes, [4, 4]. intrinsics: normalised, [3, 3]. samples: rays for a pixel's colour
    (0: none, the image is black); depth always has one of its own, through the pixel's centre.
    """
    image, depth = np.zeros((height, width, 3), np.float32), np.empty((height, width), np.float32)
    (fx, _, cx), (_, fy, cy) = intrinsics[:2] * [[width], [height]]
    cast_rays(scene, textures.texels, pose, (fx, fy, cx, cy), _sample_offsets(samples), image, depth)
    return image, depth


def look_at(eye: np.ndarray, focus: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """The camera-to-world pose [4, 4] at `eye` that looks to `focus`, upright (y down) but for `roll` in radians."""
    forward = (focus - eye) / np.linalg.norm(focus - eye)
    right = np.array([forward[2], 0.0, -forward[0]]) / np.hypot(forward[0], forward[2])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2] = forward
    pose[:3, 3] = eye
    return pose


def crop_intrinsics(intrinsics: np.ndarray, zoom: int, corner: np.ndarray) -> np.ndarray:
    """Normalised intrinsics [3, 3] of a crop of an image that is rendered `zoom` times as large.

    corner: the crop's upper left corner [2], in units of the crop's size.
    """
    return np.diag([zoom, zoom, 1.0]) @ intrinsics - np.array([[0, 0, corner[0]], [0, 0, corner[1]], [0, 0, 0]])


def probe(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """A small depth map [PROBE, PROBE]; zeros where the camera stands outside of everything."""
    bare = Textures(np.zeros((1, 1, 3), np.uint8), ())
    _, depth = render(scene, bare, pose, intrinsics, PROBE, PROBE, 0)
    return depth if np.isfinite(depth).all() else np.zeros_like(depth)


def relief(seen: np.ndarray) -> float:
    """The share of neighbouring depths of a probe that lie more than a tenth apart."""
    return float((np.abs(np.diff(np.log(seen), axis=1)) > 0.1).mean())


def _sample_offsets(samples: int) -> np.ndarray:
    """Well spread places inside a pixel (Hammersley points), [samples, 2]."""
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(16)) & 1
    radical_inverse = bits @ 0.5 ** np.arange(1, 17)
    return np.stack([(index + 0.5) / max(samples, 1), radical_inverse + 0.5 / max(samples, 1)], axis=-1)


def _sample_intrinsics(rng: np.random.Generator, views: int, aspect: float) -> np.ndarray:
    """One camera, in a part of the samples slightly another for each view, normalised, [views, 3, 3]."""
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
    """Poses [views, 4, 4] that see the scene from outside its solids and overlap; the best found if none is perfect."""
    best, best_score = np.empty(0), 0.0
    for _ in range(ATTEMPTS):
        first = look_at(rng.uniform(*layout.eyes), rng.uniform(*layout.focus), rng.normal(0, 0.06))
        seen = probe(layout.scene, first, intrinsics[0])
        if seen.min() <= 0.2 * np.median(seen):  # inside a solid, or right before one
            continue
        if relief(seen) < 0.02 and rng.random() < 0.8:  # nothing but flat walls: some of those will do
            continue
        poses = _sample_neighbour_poses(rng, first, float(np.median(seen)), context, targets)
        score = min((_overlap(layout.scene, poses, intrinsics, seen, i) for i in range(1, len(poses))), default=1.0)
        if score > best_score:
            best, best_score = poses, score
        if score > GOOD_OVERLAP:
            break
    if best_score == 0.0:  # always blocked: a row of cameras, close together, in the middle of where they may stand
        first = look_at(layout.eyes.mean(axis=0), layout.focus[1])
        best = np.stack([first] * (context + targets))
        best[:, :3, 3] += 0.01 * np.arange(context + targets)[:, None] * first[:3, 0]
    return best


def _sample_neighbour_poses(
    rng: np.random.Generator, first: np.ndarray, distance: float, context: int, targets: int
) -> np.ndarray:
    """Context poses on a path from `first` on, a few to 30 % of `distance` apart, and targets between and around."""
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
    """The share of the first view's points (depths `seen`) inside view `view`'s image; negative if that is blocked."""
    depth = probe(scene, poses[view], intrinsics[view])
    if depth.min() <= 0.12 * np.median(depth) or not 0.4 < np.median(depth) / np.median(seen) < 2.5:
        return -1.0
    centres = (np.arange(PROBE) + 0.5) / PROBE
    pixels = np.stack([*np.meshgrid(centres, centres), np.ones((PROBE, PROBE))], axis=-1)
    points = pixels @ np.linalg.inv(intrinsics[0]).T * seen[..., None]
    moved = np.linalg.inv(poses[view]) @ poses[0]
    projected = (points @ moved[:3, :3].T + moved[:3, 3]) @ intrinsics[view].T
    places = projected[..., :2] / np.maximum(projected[..., 2:], 1e-6)
    return float(((places > 0) & (places < 1)).all(axis=-1).mean())


def _sample_depth_range(rng: np.random.Generator, depth: np.ndarray) -> tuple[float, float, float]:
    """The factor that brings the scene to its final units, in which near is 1; near and far there."""
    near = float(depth.min()) * rng.uniform(0.5, 0.95)
    far = float(depth.max()) * rng.uniform(1.05, 2.0)
    if rng.random() < WIDE_RANGE_PROBABILITY:  # as where nothing is known of the scene
        near *= rng.uniform(0.3, 1.0)
        far = max(far, near * np.exp(rng.uniform(np.log(10.0), np.log(WIDEST))))
    return 1 / near, 1.0, far / near


def _simulate_camera(rng: np.random.Generator, image: np.ndarray, worn: bool, spread: CameraVariation) -> np.ndarray:
    """The image [height, width, 3] as a camera gives it: `worn` by its own exposure, blur and noise."""
    if worn:
        image = image * np.float32(rng.uniform(1 - spread.exposure, 1 + spread.exposure))
        if spread.white_balance:
            image = image * rng.uniform(1 - spread.white_balance, 1 + spread.white_balance, 3).astype(np.float32)
        blur = rng.uniform(-0.5, 0.8)  # pixels
        if blur > 0.25:
            image = cv2.GaussianBlur(image, (5, 5), blur)
        image = image + np.float32(max(rng.uniform(-0.01, 0.02), 0)) * rng.standard_normal(image.shape, np.float32)
    image = image.clip(0, 1).astype(np.float32)
    if worn and spread.compressed and rng.random() < spread.compressed:
        quality = int(rng.integers(*JPEG_QUALITY))
        _, coded = cv2.imencode(".jpg", np.rint(255 * image).astype(np.uint8), (cv2.IMWRITE_JPEG_QUALITY, quality))
        image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.float32) / 255
    return image
