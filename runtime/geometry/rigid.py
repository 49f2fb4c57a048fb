"""Rigid transforms: checks and the inverse."""

import numpy as np

from ..errors import InputError

RIGID_TOLERANCE = 1e-3  # how far a rotation's singular values may be from 1
RIGID_ROUNDING = 1e-12  # below this a rotation is left as it is, so that what we write is read back unchanged


def check_rigid(pose: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] as float64 with an orthonormal rotation.

    Raises InputError if it is not finite, or scaled, sheared or mirrored by more than rounding (1e-3).
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape != (4, 4):
        raise InputError(f"the pose has shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise InputError("the pose holds NaN or infinity, expected finite numbers")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise InputError(f"the pose's last row is {pose[3].tolist()}, expected [0, 0, 0, 1]")
    if np.abs(pose[:3, 3]).max() > MAX_COORDINATE:
        position = pose[:3, 3].tolist()
        raise InputError(f"the camera is at {position}, expected coordinates below {MAX_COORDINATE:g}")
    u, singular, vt = np.linalg.svd(pose[:3, :3])
    error = np.abs(singular - 1).max()
    if error > RIGID_TOLERANCE:
        scales = ", ".join(f"{value:g}" for value in singular)
        kind = "cannot be inverted" if singular[2] < RIGID_TOLERANCE else "is scaled or sheared"
        raise InputError(f"the pose's rotation {kind}: singular values {scales}, expected 1, 1, 1")
    if np.linalg.det(u @ vt) < 0:
        raise InputError("the pose's rotation is mirrored: determinant -1, expected 1; check the axes' convention")
    if error > RIGID_ROUNDING:
        pose = pose.copy()
        pose[:3, :3] = u @ vt
    return pose


def invert_rigid(transform: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform [4, 4]. Raises InputError as `check_rigid`."""
    transform = check_rigid(transform)
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


MAX_COORDINATE = 1e9  # a coordinate beyond this is a mistake, and float32 could not place a scene around it
