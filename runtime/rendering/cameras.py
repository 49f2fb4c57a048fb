"""Where to draw a scene from: a path through given cameras, an orbit, or a place that shows all of it.

Each is a list of cameras, named after the pictures that they make.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.trajectories import interpolate_extrinsics, orbit_extrinsics
from ..splats.gaussians import Gaussians
from .render import render_view

FIELD_OF_VIEW = math.radians(60)  # of the shorter side, where no camera is given
DOWN = (0.0, 1.0, 0.0)  # likewise: the y axis of most splat files
SEEN = 0.1  # opacity from which on a Gaussian counts as part of the scene
OUTLIERS = 5  # percent of a scene at either end of an axis that may lie outside the picture
FULL_TURN = 360.0  # degrees of an orbit around a whole scene
SWING = 30.0  # and around what cameras look at, which none of them has seen from behind
FOCUS_SIDE = 96  # pixels of the picture that finds what a camera looks at
FOCUS_ALPHA = 0.5
STILL = "still"  # what `overview` calls its camera
MOST_FRAMES = 10_000  # of a path or an orbit: more than five minutes of video, and numbers of four digits
MOST_PIXELS = 1 << 26  # of a picture: an 8K screen has half as many
LONGEST_SIDE = 1 << 16
BYTES_PER_PIXEL = 56  # that drawing takes, measured


def overview(gaussians: Gaussians, height: int, width: int) -> Camera:
    """A camera from which the scene is seen whole, from the side from which z leads away, upright where y points down.

    Raises InputError if there is nothing to see.
    """
    seen = gaussians.means[gaussians.opacities >= SEEN]
    if not len(seen):
        raise InputError(f"no Gaussian is more opaque than {SEEN}; there is nothing to draw")
    low, high = np.percentile(seen, (OUTLIERS, 100 - OUTLIERS), axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    focal = min(width, height) / 2 / math.tan(FIELD_OF_VIEW / 2)
    pose = np.eye(4)
    pose[:3, 3] = middle - [0, 0, radius / math.sin(FIELD_OF_VIEW / 2)]
    return Camera(STILL, width, height, _pinhole(focal, width, height), pose)


def along_path(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Smoothly through the cameras in their order, with the mean of their lenses, at the size of the first."""
    poses = interpolate_extrinsics(np.stack([camera.extrinsics for camera in cameras]), frames)
    first = cameras[0]
    sides = [np.array([camera.width, camera.height, 1.0])[:, None] for camera in cameras]
    K = np.mean([camera.K / side for camera, side in zip(cameras, sides, strict=True)], axis=0) * sides[0]
    return _frames(poses, K, first.width, first.height)


def around(gaussians: Gaussians, cameras: Sequence[Camera], degrees: float, frames: int) -> list[Camera]:
    """Around what the middle one of the cameras looks at, about the axis that points up in all of them.

    A full turn, or a swing to both sides that ends where it begins. Raises InputError if that camera sees nothing.
    """
    middle = cameras[len(cameras) // 2]
    down = np.mean([camera.extrinsics[:3, 1] for camera in cameras], axis=0)
    pivot = middle.extrinsics[:3, 3] + focus(gaussians, middle) * middle.extrinsics[:3, 2]
    poses = orbit_extrinsics(middle.extrinsics, pivot, -down, degrees, frames)
    return _frames(poses, middle.K, middle.width, middle.height)


def fitted(camera: Camera, height: int, width: int) -> Camera:
    """The same camera with a picture of another size, which shows all that it showed, and more where it is wider."""
    factor = min(width / camera.width, height / camera.height)
    K = camera.K * factor
    K[0, 2] += (width - factor * camera.width) / 2
    K[1, 2] += (height - factor * camera.height) / 2
    K[2, 2] = 1
    return Camera(camera.name, width, height, K, camera.extrinsics)


def focus(gaussians: Gaussians, camera: Camera) -> float:
    """The depth, in world units, at which half of what the camera sees is farther away.

    Raises InputError if it sees nothing.
    """
    factor = FOCUS_SIDE / max(camera.width, camera.height)
    small = fitted(camera, max(round(camera.height * factor), 1), max(round(camera.width * factor), 1))
    drawn = render_view(gaussians, small.extrinsics, small.K, small.width, small.height)
    seen = drawn.alpha >= FOCUS_ALPHA
    if not seen.any():
        raise InputError(f"the camera {camera.name} sees nothing of the scene; give the cameras that belong to it")
    return float(np.median(drawn.depth[seen] / drawn.alpha[seen]))


def frame_names(frames: int) -> list[str]:
    """What the cameras of a path or an orbit are called."""
    return [f"frame-{index:04d}" for index in range(frames)]


def check_shots(shots: Sequence[Camera]) -> None:
    """Raise InputError if one of the pictures would be too large to draw."""
    for shot in shots:
        if shot.width * shot.height > MOST_PIXELS or max(shot.width, shot.height) > LONGEST_SIDE:
            gigabytes = shot.width * shot.height * BYTES_PER_PIXEL / 1e9
            raise InputError(
                f"{shot.name}: a picture of {shot.width} x {shot.height} pixels would take {gigabytes:.1f} GB to draw; "
                f"expected {MOST_PIXELS:,} pixels and sides of {LONGEST_SIDE:,} at most; give a smaller --size"
            )


def _frames(poses: np.ndarray, K: np.ndarray, width: int, height: int) -> list[Camera]:
    names = frame_names(len(poses))
    return [Camera(name, width, height, K, pose) for name, pose in zip(names, poses, strict=True)]


def _pinhole(focal: float, width: int, height: int) -> np.ndarray:
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
