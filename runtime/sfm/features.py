"""Local features and two-view geometry: SIFT, mutual matching, the Sampson distance and triangulation.

Keypoints are in pixels, with the centre of the top left pixel at (0.5, 0.5). Normalised image coordinates are
(X / Z, Y / Z) in the frame of a camera, that is, on the plane Z = 1.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.intrinsics import HALF_PIXEL
from ..geometry.rigid import invert_rigid

MAX_FEATURES = 4000  # of one image
CONTRAST_THRESHOLD = 0.02  # half of OpenCV's default, for indoor walls
MAX_RATIO = 0.8  # of the distances of the best and the second best match (Lowe 2004, section 7.1)
EPSILON = 1e-12


@dataclass(frozen=True, eq=False)
class Features:
    """keypoints: pixels [features, 2]. descriptors: RootSIFT, of length 1, float32 [features, 128]."""

    keypoints: np.ndarray
    descriptors: np.ndarray


def extract_features(image: np.ndarray, max_features: int = MAX_FEATURES) -> Features:
    """SIFT features of an image, uint8 RGB [height, width, 3] or grey [height, width]; may be none."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    # Without the precise upscale, OpenCV's keypoints are shifted by a quarter of a pixel to the right and down.
    sift = cv2.SIFT.create(max_features, contrastThreshold=CONTRAST_THRESHOLD, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    keypoints = np.array([keypoint.pt for keypoint in found]) + HALF_PIXEL
    # RootSIFT (Arandjelovic & Zisserman 2012): square roots of the L1-normalised histograms.
    normalized = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), EPSILON)
    return Features(keypoints, np.sqrt(normalized).astype(np.float32))


def match_features(first: Features, second: Features, max_ratio: float = MAX_RATIO) -> np.ndarray:
    """Index pairs [matches, 2] of mutual nearest neighbours that pass the ratio test; 1 passes all but ties."""
    if min(len(first.keypoints), len(second.keypoints)) < 2:
        return np.zeros((0, 2), int)
    # Descriptors have length 1, so 1 - similarity is half the squared distance.
    similarity = first.descriptors @ second.descriptors.T  # [first, second]
    forward, backward = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.arange(len(forward))
    best = similarity[rows, forward]
    similarity[rows, forward] = -1
    next_best = similarity.max(axis=1)
    good = (backward[forward] == rows) & (1 - best < max_ratio**2 * (1 - next_best))
    return np.stack([rows, forward], axis=1)[good]


def normalize_points(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Normalised image coordinates [points, 2] of pixels [points, 2]. K: intrinsics without skew, [3, 3]."""
    return (points - K[:2, 2]) / np.diag(K)[:2]


def sampson_distance(
    first: np.ndarray, second: np.ndarray, second_from_first: np.ndarray, signed: bool = False
) -> np.ndarray:
    """Sampson distance of matches, [points], in normalised image coordinates: the first-order geometric error

        |x2^T E x1| / sqrt((E x1)_1^2 + (E x1)_2^2 + (E^T x2)_1^2 + (E^T x2)_2^2),    E = [t]x R

    (Hartley & Zisserman, Multiple View Geometry, 2nd ed.: eq. 9.12 for E, and the square root of eq. 11.9).
    first, second: matched normalised image coordinates, [points, 2] each.
    second_from_first: transforms points from the first camera's frame to the second's, [4, 4].
    signed: with the sign of x2^T E x1, for least squares.
    """
    rotation, (x, y, z) = second_from_first[:3, :3], second_from_first[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    ones = np.ones((len(first), 1))
    lines = np.hstack([first, ones]) @ essential.T  # E x1, epipolar lines in the second image, [points, 3]
    lines_back = np.hstack([second, ones]) @ essential  # E^T x2
    residual = (np.hstack([second, ones]) * lines).sum(axis=1)
    gradient = (lines[:, :2] ** 2).sum(axis=1) + (lines_back[:, :2] ** 2).sum(axis=1)
    error = residual / np.sqrt(np.maximum(gradient, EPSILON))
    return error if signed else np.abs(error)


def triangulate(first: np.ndarray, second: np.ndarray, second_from_first: np.ndarray) -> np.ndarray:
    """Midpoint triangulation (Hartley & Sturm 1997, section 5.3): points [points, 3] in the first camera's frame.

    A point is the midpoint between the closest points of its two viewing rays. first, second: normalised image
    coordinates, [points, 2] each. Points of nearly parallel rays are far away, or behind the cameras.
    """
    ones = np.ones((len(first), 1))
    first_from_second = invert_rigid(second_from_first)
    a = np.hstack([first, ones])
    b = np.hstack([second, ones]) @ first_from_second[:3, :3].T
    a, b = a / np.linalg.norm(a, axis=1, keepdims=True), b / np.linalg.norm(b, axis=1, keepdims=True)
    centre = first_from_second[:3, 3]
    # The minimum of |s a - (centre + t b)|^2: two linear equations in s and t.
    cosine = (a * b).sum(axis=1)
    sine_squared = np.maximum(1 - cosine**2, EPSILON)
    s = (a @ centre - cosine * (b @ centre)) / sine_squared
    t = (cosine * (a @ centre) - b @ centre) / sine_squared
    return (s[:, None] * a + centre + t[:, None] * b) / 2


def parallax_angles(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Angles in degrees [points] between viewing rays to points [points, 3] from the origin and from `centre` [3]."""
    other = points - centre
    cross = np.linalg.norm(np.cross(points, other), axis=1)
    return np.degrees(np.arctan2(cross, (points * other).sum(axis=1)))
