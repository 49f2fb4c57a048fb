"""Cameras to render from: an overview, a path through given cameras, or an orbit.

The name of a camera is the stem of the image that is rendered from it.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.trajectories import interpolate_extrinsics, orbit_extrinsics
from ..splats.gaussians import Gaussians
from ..system.output_names import frame_names
from .render import median_depth, render_view

OVERVIEW_FOV = math.radians(60)  # of the shorter side
MIN_OPACITY = 0.1  # of Gaussians that count as part of the scene
OUTLIERS = 5  # percent of the scene at either end of an axis that may lie outside the image
SCENE_ORBIT_DEG = 360.0  # of an orbit from the overview
CAMERA_ORBIT_DEG = 30.0  # of an orbit about what cameras look at: none of them has seen its back
LEAST_DOWN = 1e-3  # length of the mean of unit vectors, below which it tells no direction
FOCUS_SIDE = 96  # pixels, longer side of the rendering that `focus_depth` measures
OVERVIEW_NAME = "still"
MAX_FRAMES = 10_000  # of a path or an orbit: five minutes of video at 30 frames a second, and numbers of four digits
MAX_PIXELS = 1 << 26  # of an image; 8K has half as many
MAX_SIDE = 1 << 16  # pixels
BYTES_PER_PIXEL = 56  # peak memory of rendering, measured


def overview_camera(gaussians: Gaussians, height: int, width: int) -> Camera:
    """A camera that sees the whole scene: looking along z, y down, with a field of view of 60 degrees.

    Raises InputError if no Gaussian is opaque enough.
    """
    visible = gaussians.means[gaussians.opacities >= MIN_OPACITY]
    if not len(visible):
        raise InputError(f"no Gaussian has an opacity of {MIN_OPACITY} or more; there is nothing to render")
    low, high = np.percentile(visible, (OUTLIERS, 100 - OUTLIERS), axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    focal = min(width, height) / 2 / math.tan(OVERVIEW_FOV / 2)
    pose = np.eye(4)
    pose[:3, 3] = middle - [0, 0, radius / math.sin(OVERVIEW_FOV / 2)]
    return Camera(OVERVIEW_NAME, width, height, _pinhole(focal, width, height), pose)


def path_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Cameras on a smooth path through the given ones in their order, with the mean of their normalised K.

    The size is that of the first.
    """
    poses = interpolate_extrinsics(np.stack([camera.extrinsics for camera in cameras]), frames)
    first = cameras[0]
    sides = [np.array([camera.width, camera.height, 1.0])[:, None] for camera in cameras]
    K = np.mean([camera.K / side for camera, side in zip(cameras, sides, strict=True)], axis=0) * sides[0]
    return _frames(poses, K, first.width, first.height)


def orbit_cameras(gaussians: Gaussians, cameras: Sequence[Camera], degrees: float, frames: int) -> list[Camera]:
    """Cameras on an orbit about what the middle one looks at, around the mean up direction of the given cameras.

    Where their directions cancel, around that of the middle one.

    degrees: 360 for a full turn; less for a swing to both sides that ends where it begins (`orbit_extrinsics`).
    Raises InputError if the middle camera sees nothing.
    """
    middle = cameras[len(cameras) // 2]
    down = np.mean([camera.extrinsics[:3, 1] for camera in cameras], axis=0)
    if np.linalg.norm(down) < LEAST_DOWN:
        down = middle.extrinsics[:3, 1]
    pivot = middle.extrinsics[:3, 3] + focus_depth(gaussians, middle) * middle.extrinsics[:3, 2]
    poses = orbit_extrinsics(middle.extrinsics, pivot, -down, degrees, frames)
    return _frames(poses, middle.K, middle.width, middle.height)


def fit_camera(camera: Camera, height: int, width: int) -> Camera:
    """The camera with an image of another size that contains the whole former image, centred (letterboxed)."""
    factor = min(width / camera.width, height / camera.height)
    K = camera.K * factor
    K[0, 2] += (width - factor * camera.width) / 2
    K[1, 2] += (height - factor * camera.height) / 2
    K[2, 2] = 1
    return Camera(camera.name, width, height, K, camera.extrinsics)


def focus_depth(gaussians: Gaussians, camera: Camera) -> float:
    """Median depth of what the camera sees, in world units, over the pixels with alpha >= `render.SOLID`.

    Raises InputError if there are none.
    """
    factor = FOCUS_SIDE / max(camera.width, camera.height)
    small = fit_camera(camera, max(round(camera.height * factor), 1), max(round(camera.width * factor), 1))
    rendering = render_view(gaussians, small.extrinsics, small.K, small.width, small.height)
    depth = median_depth(rendering)
    if depth is None:
        raise InputError(f"the camera {camera.name} sees nothing of the scene; give the cameras that belong to it")
    return depth


def check_image_sizes(cameras: Sequence[Camera]) -> None:
    """Raise InputError if one of the images is too large to render."""
    for camera in cameras:
        if camera.width * camera.height > MAX_PIXELS or max(camera.width, camera.height) > MAX_SIDE:
            gigabytes = camera.width * camera.height * BYTES_PER_PIXEL / 1e9
            size = f"{camera.width} x {camera.height}"
            raise InputError(
                f"{camera.name}: an image of {size} pixels would take {gigabytes:.1f} GB to render; "
                f"expected {MAX_PIXELS:,} pixels and sides of {MAX_SIDE:,} at most; give a smaller --size"
            )


def _frames(poses: np.ndarray, K: np.ndarray, width: int, height: int) -> list[Camera]:
    names = frame_names(len(poses))
    return [Camera(name, width, height, K, pose) for name, pose in zip(names, poses, strict=True)]


def _pinhole(focal: float, width: int, height: int) -> np.ndarray:
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
