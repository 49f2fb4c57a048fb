"""Rigid transforms [R t; 0 1]: checks, the inverse, and points moved by them."""

import numpy as np

from ..errors import InputError

RIGID_TOLERANCE = 1e-3  # of the singular values of a rotation, which are 1
RIGID_ROUNDING = 1e-12  # rotations this close are not changed, so that files are read back exactly
MAX_COORDINATE = 1e9  # larger coordinates are taken for errors; float32 has no precision left for a scene there


def check_rigid(pose: np.ndarray) -> np.ndarray:
    """The pose [4, 4] as float64, its rotation replaced by the nearest orthonormal one (by SVD).

    Raises InputError if it is not finite, or scaled, sheared or mirrored beyond a tolerance of 1e-3.
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
        raise InputError(
            "the pose's rotation is mirrored: determinant -1, expected 1; check the convention of the axes"
        )
    if error > RIGID_ROUNDING:
        pose = pose.copy()
        pose[:3, :3] = u @ vt
    return pose


def invert_rigid(transform: np.ndarray) -> np.ndarray:
    """The inverse [R^T, -R^T t; 0, 1] of a rigid transform [4, 4], float64. Raises InputError as `check_rigid`."""
    transform = check_rigid(transform)
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def transform_points(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The points R p + t of a rigid transform [4, 4], in the type that both promote to; points: [..., 3]."""
    moved: np.ndarray = points @ transform[:3, :3].T + transform[:3, 3]
    return moved
