"""Points that two photographs share: found by SIFT, matched both ways, held against the epipolar line, triangulated.

Places in a picture are pixels with the centre of the first at (.5, .5); rays are (x / z, y / z) in a camera's frame.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.intrinsics import HALF_PIXEL
from ..geometry.rigid import invert_rigid

MOST_FEATURES = 4000  # of one picture
CONTRAST = 0.02  # half of SIFT's own threshold, for indoor walls
DISTINCT = 0.8  # a match's distance over that of the second best
TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Features:
    """keypoints: pixels [features, 2]. descriptors: roots of SIFT's shares, of length 1, float32 [features, 128]."""

    keypoints: np.ndarray
    descriptors: np.ndarray


def extract_features(image: np.ndarray, most: int = MOST_FEATURES) -> Features:
    """SIFT features of a picture, uint8 RGB [height, width, 3] or grey [height, width]; maybe none."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    # Without the precise upscale, OpenCV's keypoints lie a quarter of a pixel too far to the right and down.
    sift = cv2.SIFT.create(most, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    keypoints = np.array([keypoint.pt for keypoint in found]) + HALF_PIXEL
    # Distances between square roots of SIFT's histograms tell matches apart better (RootSIFT).
    shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), TINY)
    return Features(keypoints, np.sqrt(shares).astype(np.float32))


def match_features(first: Features, second: Features) -> np.ndarray:
    """Pairs of indices [matches, 2]: features that are each other's nearest, clearly nearer than the next."""
    if min(len(first.keypoints), len(second.keypoints)) < 2:
        return np.zeros((0, 2), int)
    # Descriptors have length 1: one minus the likeness is half the squared distance.
    likeness = first.descriptors @ second.descriptors.T  # [first, second]
    forth, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    rows = np.arange(len(forth))
    best = likeness[rows, forth]
    likeness[rows, forth] = -1
    next_best = likeness.max(axis=1)
    good = (back[forth] == rows) & (1 - best < DISTINCT**2 * (1 - next_best))
    return np.stack([rows, forth], axis=1)[good]


def normalize_points(keypoints: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Points [points, 2] in a picture of a pinhole camera K [3, 3] as rays [points, 2]."""
    return (keypoints - K[:2, 2]) / np.diag(K)[:2]


def sampson_distance(
    first: np.ndarray, second: np.ndarray, second_from_first: np.ndarray, signed: bool = False
) -> np.ndarray:
    """How far two rays, both [points, 2], are from meeting: Sampson's distance [points], on the plane z = 1.

    second_from_first: what takes points from the first camera's frame to the second's, [4, 4].
    """
    rotation, (x, y, z) = second_from_first[:3, :3], second_from_first[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    ones = np.ones((len(first), 1))
    lines = np.hstack([first, ones]) @ essential.T  # [points, 3], in the second picture
    lines_back = np.hstack([second, ones]) @ essential
    residual = (np.hstack([second, ones]) * lines).sum(axis=1)
    slope = (lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1)
    error = residual / np.sqrt(np.maximum(slope, TINY))
    return error if signed else np.abs(error)


def triangulate(first: np.ndarray, second: np.ndarray, second_from_first: np.ndarray) -> np.ndarray:
    """Where rays [points, 2] of two cameras come closest to meeting, in the first camera's frame, [points, 3].

    Parallel rays meet far away, or behind the cameras.
    """
    ones = np.ones((len(first), 1))
    first_from_second = invert_rigid(second_from_first)
    a = np.hstack([first, ones])
    b = np.hstack([second, ones]) @ first_from_second[:3, :3].T
    a, b = a / np.linalg.norm(a, axis=1, keepdims=True), b / np.linalg.norm(b, axis=1, keepdims=True)
    centre = first_from_second[:3, 3]
    # Least squares of |s a - (centre + t b)|: two equations in s and t.
    cosine = (a * b).sum(axis=1)
    sine_squared = np.maximum(1 - cosine**2, TINY)
    s = (a @ centre - cosine * (b @ centre)) / sine_squared
    t = (cosine * (a @ centre) - b @ centre) / sine_squared
    return (s[:, None] * a + centre + t[:, None] * b) / 2


def parallax_angles(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The angle in degrees [points] between the sights of points [points, 3] from the origin and from `centre` [3]."""
    other = points - centre
    cross = np.linalg.norm(np.cross(points, other), axis=1)
    return np.degrees(np.arctan2(cross, (points * other).sum(axis=1)))
