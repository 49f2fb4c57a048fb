"""Relative pose of two calibrated views from matched normalised image coordinates.

The essential matrix is estimated by five-point RANSAC (Nister 2004, in OpenCV) and decomposed into four poses, of which
the one with most points in front of both cameras is kept (Hartley & Zisserman, section 9.6.3). That pose is refined by
minimising the Sampson distance.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.rigid import transform_points
from .features import parallax_angles, sampson_distance, triangulate

# Variants of RANSAC fail on different inputs; each gives an initial pose, and the one with most inliers is kept.
ESTIMATORS = (cv2.USAC_MAGSAC, cv2.USAC_ACCURATE, cv2.RANSAC)
CONFIDENCE = 0.9999
MIN_MATCHES = 8
REFINEMENTS = 20
STEP = 1e-6  # for numeric derivatives, in radians
DAMPING = 1e-9


@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """The relative pose of two views and the points that both see.

    second_from_first: transforms points from the first camera's frame to the second's, [4, 4]; the baseline is 1.
    inliers: matches below the tolerance whose point is in front of both cameras, bool [matches].
    points: the triangulated inliers, in the first camera's frame, [points, 3].
    parallax_deg: median angle between the two viewing rays of a point.
    """

    second_from_first: np.ndarray
    inliers: np.ndarray
    points: np.ndarray
    parallax_deg: float


def estimate_relative_pose(first: np.ndarray, second: np.ndarray, tolerance: float) -> TwoViewGeometry | None:
    """The relative pose with most inliers, or None if none is found.

    first, second: matched normalised image coordinates, with outliers, [matches, 2] each.
    tolerance: maximum Sampson distance of an inlier; about a pixel divided by the focal length.
    """
    if len(first) < MIN_MATCHES:
        return None
    initial = [pose for method in ESTIMATORS for pose in _initial_poses(first, second, tolerance, method)]
    if not initial:
        return None
    refined = [_refine(first, second, pose, tolerance) for pose in initial]
    geometries = [_triangulate_inliers(first, second, pose, tolerance) for pose in refined]
    return max(geometries, key=lambda geometry: int(geometry.inliers.sum()))


def rotation_only_inlier_ratio(first: np.ndarray, second: np.ndarray, tolerance: float) -> float:
    """The fraction of matches that a pure rotation explains: viewing rays that agree after it, up to the tolerance.

    The rotation is the solution of a robust Kabsch (orthogonal Procrustes) problem, by iteratively reweighted least
    squares. Arguments as for `estimate_relative_pose`.
    """
    a, b = (np.hstack([points, np.ones((len(points), 1))]) for points in (first, second))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    weights = np.ones(len(a))
    for _ in range(REFINEMENTS):
        u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # from the first view to the second
        residual = np.linalg.norm(a @ rotation.T - b, axis=1)
        weights = 1 / (1 + (residual / tolerance) ** 2)
    return float((residual < tolerance).mean())


def _initial_poses(first: np.ndarray, second: np.ndarray, tolerance: float, method: int) -> list[np.ndarray]:
    """The pose of the essential matrix that an estimator finds, with most points in front of both cameras; or none."""
    scale = 1 / tolerance  # the estimators expect units of about a pixel
    K = np.diag([scale, scale, 1.0])
    try:
        essential, _ = cv2.findEssentialMat(
            first * scale, second * scale, K, method=method, prob=CONFIDENCE, threshold=1.0
        )
    except cv2.error:
        return []
    if essential is None or essential.shape[0] < 3 or not np.isfinite(essential).all():
        return []
    rotations = cv2.decomposeEssentialMat(essential[:3])
    candidates = [_pose(rotation, sign * rotations[2].ravel()) for rotation in rotations[:2] for sign in (1, -1)]
    return [max(candidates, key=lambda pose: int(_triangulate_inliers(first, second, pose, tolerance).inliers.sum()))]


def _pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation / np.linalg.norm(translation)
    return pose


def _triangulate_inliers(first: np.ndarray, second: np.ndarray, pose: np.ndarray, tolerance: float) -> TwoViewGeometry:
    """The inliers of a pose, and their points."""
    points = triangulate(first, second, pose)
    in_second = transform_points(pose, points)
    inliers = (sampson_distance(first, second, pose) < tolerance) & (points[:, 2] > 0) & (in_second[:, 2] > 0)
    points = points[inliers]
    angles = parallax_angles(points, -pose[:3, :3].T @ pose[:3, 3])
    return TwoViewGeometry(pose, inliers, points, float(np.median(angles)) if len(points) else 0.0)


def _refine(first: np.ndarray, second: np.ndarray, pose: np.ndarray, tolerance: float) -> np.ndarray:
    """Minimise the Sampson distances by Gauss-Newton steps with Cauchy weights against outliers."""
    for _ in range(REFINEMENTS):
        errors = sampson_distance(first, second, pose, signed=True)
        steps = np.eye(5) * STEP
        shifted = [sampson_distance(first, second, _perturbed(pose, step), signed=True) for step in steps]
        jacobian = (np.stack(shifted, axis=1) - errors[:, None]) / STEP  # [matches, 5]
        weighted = jacobian / (1 + (errors / tolerance) ** 2)[:, None]
        change = np.linalg.solve(weighted.T @ jacobian + DAMPING * np.eye(5), -weighted.T @ errors)
        pose = _perturbed(pose, change)
    return pose


def _perturbed(pose: np.ndarray, change: np.ndarray) -> np.ndarray:
    """A pose after a change [5]: a rotation vector, and two components of translation in the plane tangent to it."""
    translation = pose[:3, 3]
    tangents = np.linalg.svd(translation[None])[2][1:]  # an orthonormal basis of the plane, [2, 3]
    return _pose(cv2.Rodrigues(change[:3])[0] @ pose[:3, :3], translation + change[3:] @ tangents)
