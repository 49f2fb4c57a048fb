"""Views of a synthetic scene: images and depth maps of a camera, and small depth maps that tell what it sees."""

import numpy as np

from ...runtime.geometry.intrinsics import crop_intrinsics, denormalize_intrinsics, scale_intrinsics
from .raycast import ELLIPSOID, Scene, cast_rays
from .textures import Textures

# Side in pixels of the small depth map from which a camera pose is scored.
PROBE = 24


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
    inside = is_enclosed(scene, pose[:3, 3]) and np.isfinite(depth).all()
    return depth if inside else np.zeros_like(depth)


def is_enclosed(scene: Scene, point: np.ndarray) -> bool:
    """Whether a point [3] is inside the enclosing solid, a box or an ellipsoid. From outside some rays hit nothing."""
    unit = scene.axes[0] @ (point - scene.centres[0]) / scene.halves[0]
    size = np.linalg.norm(unit) if scene.shapes[0] == ELLIPSOID else np.abs(unit).max()
    return bool(size < 1)


def depth_edge_share(seen: np.ndarray) -> float:
    """The share of horizontally neighbouring depths of a probe that differ by more than about 10 %."""
    return float((np.abs(np.diff(np.log(seen), axis=1)) > 0.1).mean())


def _pixel_offsets(samples: int) -> np.ndarray:
    """Positions inside a pixel, [samples, 2]: a Hammersley point set."""
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(16)) & 1
    radical_inverse = bits @ 0.5 ** np.arange(1, 17)
    return np.stack([(index + 0.5) / max(samples, 1), radical_inverse + 0.5 / max(samples, 1)], axis=-1)
