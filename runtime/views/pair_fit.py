"""Whether two images fit their cameras: where the points matched between them lie, relative to their epipolar lines.

Lengths are in pixels of an image whose longer side is FEATURE_SIDE, unless the image is smaller.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from ..geometry.baselines import have_baseline
from ..geometry.rigid import invert_rigid, transform_points
from ..sfm.features import EPSILON, match_features, normalize_points, sampson_distance, triangulate
from ..sfm.two_view import estimate_relative_pose
from .loader import FEATURE_SIDE, FeatureImage

MAX_INLIER_ERROR = 3.0  # of a match that fits; the median of good captures is 0.1 to 1
MIN_PIXELS = 1.5  # of the copy, which the inlier error is at least: keypoints are not more exact
MIN_INLIERS, MIN_INLIER_RATIO = 8, 0.3  # of a pair that fits
# A pair contradicts its cameras if few of its matches fit them, although most are right: another pose explains them.
MAX_ERROR, MAX_CONTRADICTION_RATIO = 5.0, 0.2
MIN_MATCHES, MIN_EXPLAINED = 40, 0.6
# One image saved twice: most of its matches are at the same place, also as JPEG of quality 75. Between views of one
# scene they move by several pixels.
SAME_PLACE, SAME_PLACE_PERCENTILE = 0.6, 80
MIN_SAME_SIDE = 240  # pixels of the shorter side: in smaller images neighbouring views differ as little
# Images of two scenes have inliers by chance: at most two, in a thousand pairs, and among mutual nearest neighbours,
# which include repeated texture, up to six times the share of the image that is within the inlier error of a line. Of
# 1200 pairs of one scene that overlap surely (see `checks`), one had as few, and its camera is wrong.
MAX_CHANCE_INLIERS, MAX_CHANCE_RATIO, MIN_NEIGHBOURS = 4, 6.0, 40


class Verdict(Enum):
    """FITS: the images fit their cameras. CONTRADICTS: their matches are right, and do not fit the cameras.

    UNRELATED: they have no point in common. IDENTICAL: they are one image, saved twice. UNKNOWN: none for sure.
    """

    FITS = "fits"
    CONTRADICTS = "contradicts"
    UNRELATED = "unrelated"
    IDENTICAL = "identical"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class PairFit:
    """matches: how many. inliers: those of them that fit. error: their median distance from the epipolar lines."""

    verdict: Verdict
    matches: int = 0
    inliers: int = 0
    error: float = 0.0

    @property
    def fails(self) -> bool:
        """Whether the images do not belong together, or their cameras to them."""
        return self.verdict in (Verdict.CONTRADICTS, Verdict.UNRELATED)

    def describe(self, between: str) -> str:
        """The numbers, for the user. between: what the points are matched with or between, such as `with a.jpg`."""
        if self.verdict is Verdict.CONTRADICTS:
            return (
                f"{self.matches} points matched {between} are {self.error:.0f} pixels from their epipolar lines "
                f"(median, at {FEATURE_SIDE} pixels), expected {MAX_ERROR:.0f} at most"
            )
        return (
            f"{self.inliers} of {self.matches} points matched {between} fit the cameras, "
            f"expected {MIN_INLIERS} at least"
        )


def fit_pair(first: FeatureImage, second: FeatureImage) -> PairFit:
    """How two images fit their cameras."""
    poses = np.stack([first.camera.extrinsics, second.camera.extrinsics])
    if not have_baseline(poses):
        return PairFit(Verdict.UNKNOWN)  # without a baseline there are no epipolar lines
    second_from_first = invert_rigid(poses[1]) @ poses[0]
    matches = first.match(second)
    rays = _rays(first, second, matches)
    pixel, size = _pixel(first, second)
    errors = _epipolar_errors(*rays, second_from_first) / pixel
    inliers, error = int((errors < MAX_INLIER_ERROR).sum()), float(np.median(errors)) if len(errors) else 0.0
    if size >= MIN_SAME_SIDE and _are_identical(rays, pixel):
        verdict = Verdict.IDENTICAL
    elif inliers >= max(MIN_INLIERS, MIN_INLIER_RATIO * len(matches)):
        verdict = Verdict.FITS
    elif _contradict(rays, errors, pixel):
        verdict = Verdict.CONTRADICTS
    else:
        neighbours = _rays(first, second, match_features(first.inside, second.inside, max_ratio=1))
        near = _epipolar_errors(*neighbours, second_from_first) / pixel < MAX_INLIER_ERROR
        by_chance = len(near) >= MIN_NEIGHBOURS and near.mean() < MAX_CHANCE_RATIO * 2 * MAX_INLIER_ERROR / size
        verdict = Verdict.UNRELATED if by_chance and inliers <= MAX_CHANCE_INLIERS else Verdict.UNKNOWN
    return PairFit(verdict, len(matches), inliers, error)


def _rays(first: FeatureImage, second: FeatureImage, matches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalised image coordinates of matches, [matches, 2] each."""
    return (
        normalize_points(first.inside.keypoints[matches[:, 0]], first.camera.K),
        normalize_points(second.inside.keypoints[matches[:, 1]], second.camera.K),
    )


def _pixel(first: FeatureImage, second: FeatureImage) -> tuple[float, float]:
    """The unit of lengths in normalised image coordinates, and the shorter side of the images in it."""
    cameras = first.camera, second.camera
    sides = [max(camera.width, camera.height) for camera in cameras]
    unit = max(max(sides) / FEATURE_SIDE, MIN_PIXELS / MAX_INLIER_ERROR)  # in pixels of the copies
    focal = float(np.sqrt(cameras[0].K[0, 0] * cameras[1].K[0, 0]))
    return unit / focal, min(min(camera.width, camera.height) for camera in cameras) / unit


def _epipolar_errors(first: np.ndarray, second: np.ndarray, second_from_first: np.ndarray) -> np.ndarray:
    """Distances [points] of matches from their epipolar lines, of which only the part before the cameras counts.

    Points that would be behind a camera are measured from the end of the line, the image of a point at infinity, since
    the Sampson distance is the same for two cameras that are exchanged by a translation.
    """
    sampson = sampson_distance(first, second, second_from_first)
    points = triangulate(first, second, second_from_first)
    in_second = transform_points(second_from_first, points)
    at_infinity = np.hstack([first, np.ones((len(first), 1))]) @ second_from_first[:3, :3].T
    end = at_infinity[:, :2] / np.maximum(at_infinity[:, 2:], EPSILON)  # far away if it is behind
    behind = (points[:, 2] <= 0) | (in_second[:, 2] <= 0)
    return np.where(behind, np.maximum(sampson, np.linalg.norm(end - second, axis=1)), sampson)


def _are_identical(rays: tuple[np.ndarray, np.ndarray], pixel: float) -> bool:
    """Whether matches are at the same place in both images."""
    if len(rays[0]) < MIN_MATCHES:
        return False
    moved = np.linalg.norm(rays[0] - rays[1], axis=1) / pixel
    return bool(np.percentile(moved, SAME_PLACE_PERCENTILE) < SAME_PLACE)


def _contradict(rays: tuple[np.ndarray, np.ndarray], errors: np.ndarray, pixel: float) -> bool:
    """Whether matches do not fit the cameras, and another relative pose explains most of them."""
    if len(errors) < MIN_MATCHES or np.median(errors) <= MAX_ERROR:
        return False
    if (errors < MAX_INLIER_ERROR).mean() > MAX_CONTRADICTION_RATIO:
        return False
    found = estimate_relative_pose(*rays, MAX_INLIER_ERROR * pixel)
    return found is not None and float(found.inliers.mean()) >= MIN_EXPLAINED
