"""Camera poses that are refined together with the scene."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..cameras.camera import Camera
from ..geometry.rigid import invert_rigid


def move_world(viewmat: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The world-to-camera pose [4, 4] that shows a moved world, as the gradient of `GradientRasterizer.pose_gradient`.

    motion: a rotation vector in radians about the camera's centre, then a translation, in world axes, [6].
    """
    centre = invert_rigid(viewmat)[:3, 3]
    world = np.eye(4)
    world[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    world[:3, 3] = centre - world[:3, :3] @ centre + motion[3:]
    moved: np.ndarray = viewmat @ world
    return moved


def refined_cameras(cameras: Sequence[Camera], viewmats: np.ndarray, offset: np.ndarray) -> list[Camera]:
    """The cameras with the poses of a refinement; offset: the origin [3] of the scene's world in theirs."""
    poses = [invert_rigid(viewmat) for viewmat in viewmats]
    for pose in poses:
        pose[:3, 3] += offset
    return [replace(camera, extrinsics=pose) for camera, pose in zip(cameras, poses, strict=True)]
