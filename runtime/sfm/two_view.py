"""Where the second of two cameras stands, from the rays along which both see the same points."""

from dataclasses import dataclass

import cv2
import numpy as np

from .features import parallax_angles, sampson_distance, triangulate

# Estimators differ in where they go wrong; each gives a start, and the one that explains most is kept.
ESTIMATORS = (cv2.USAC_MAGSAC, cv2.USAC_ACCURATE, cv2.RANSAC)
CONFIDENCE = 0.9999
FEWEST_MATCHES = 8
REFINEMENTS = 20
STEP = 1e-6  # for numeric derivatives: radians, and shares of the baseline
DAMPING = 1e-9


@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """Two cameras and what both see.

    second_from_first: takes points from the first camera's frame to the second's, [4, 4]; the baseline is 1.
    inliers: which of the given rays agree with it, and meet before both cameras, bool [rays].
    points: where those meet, in the first camera's frame, [points, 3].
    parallax_deg: median angle between the two sights of a point.
    """

    second_from_first: np.ndarray
    inliers: np.ndarray
    points: np.ndarray
    parallax_deg: float


def estimate_relative_pose(first: np.ndarray, second: np.ndarray, tolerance: float) -> TwoViewGeometry | None:
    """The relative pose that most rays agree with, or None where none is found.

    first, second: rays (x / z, y / z) [rays, 2] of the two cameras, some of them of different points.
    tolerance: how far a ray may lie from where it should, on the plane z = 1; about a pixel over the focal length.
    """
    if len(first) < FEWEST_MATCHES:
        return None
    starts = [pose for method in ESTIMATORS for pose in _starts(first, second, tolerance, method)]
    if not starts:
        return None
    refined = [_refine(first, second, pose, tolerance) for pose in starts]
    found = [_explain(first, second, pose, tolerance) for pose in refined]
    return max(found, key=lambda views: int(views.inliers.sum()))


def rotation_only_inlier_ratio(first: np.ndarray, second: np.ndarray, tolerance: float) -> float:
    """The share of rays, as for `estimate_relative_pose`, that a camera which only turned would have seen as well."""
    a, b = (np.hstack([rays, np.ones((len(rays), 1))]) for rays in (first, second))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    weights = np.ones(len(a))
    for _ in range(REFINEMENTS):
        u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # Kabsch's rotation from the first to the second
        off = np.linalg.norm(a @ turn.T - b, axis=1)
        weights = 1 / (1 + (off / tolerance) ** 2)
    return float((off < tolerance).mean())


def _starts(first: np.ndarray, second: np.ndarray, tolerance: float, method: int) -> list[np.ndarray]:
    """The poses that an estimator's essential matrix allows, the one with most points before both cameras."""
    scale = 1 / tolerance  # so that a pixel is the unit, as the estimators like it
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
    return [max(candidates, key=lambda pose: int(_explain(first, second, pose, tolerance).inliers.sum()))]


def _pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation / np.linalg.norm(translation)
    return pose


def _explain(first: np.ndarray, second: np.ndarray, pose: np.ndarray, tolerance: float) -> TwoViewGeometry:
    """What a pose makes of the rays."""
    points = triangulate(first, second, pose)
    there = points @ pose[:3, :3].T + pose[:3, 3]
    inliers = (sampson_distance(first, second, pose) < tolerance) & (points[:, 2] > 0) & (there[:, 2] > 0)
    points = points[inliers]
    angles = parallax_angles(points, -pose[:3, :3].T @ pose[:3, 3])
    return TwoViewGeometry(pose, inliers, points, float(np.median(angles)) if len(points) else 0.0)


def _refine(first: np.ndarray, second: np.ndarray, pose: np.ndarray, tolerance: float) -> np.ndarray:
    """Move a pose to where the rays' errors are least, far-off ones counting ever less (Cauchy's weights)."""
    for _ in range(REFINEMENTS):
        errors = sampson_distance(first, second, pose, signed=True)
        steps = np.eye(5) * STEP
        moved = [sampson_distance(first, second, _moved(pose, step), signed=True) for step in steps]
        slopes = (np.stack(moved, axis=1) - errors[:, None]) / STEP  # [rays, 5]
        weighted = slopes / (1 + (errors / tolerance) ** 2)[:, None]
        change = np.linalg.solve(weighted.T @ slopes + DAMPING * np.eye(5), -weighted.T @ errors)
        pose = _moved(pose, change)
    return pose


def _moved(pose: np.ndarray, change: np.ndarray) -> np.ndarray:
    """A pose turned by three angles, its translation turned by two about axes across it: change [5]."""
    translation = pose[:3, 3]
    across = np.linalg.svd(translation[None])[2][1:]  # two directions at right angles to it, [2, 3]
    return _pose(cv2.Rodrigues(change[:3])[0] @ pose[:3, :3], translation + change[3:] @ across)
