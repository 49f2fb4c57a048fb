"""Quaternions wxyz: normalisation, conversion to and from rotation matrices, and the smallest-three encoding.

Smallest three: since q and -q are the same rotation, a unit quaternion can be stored as the index of its largest
component, made positive, and the other three, which lie in [-sqrt(1/2), sqrt(1/2)]; the largest is
sqrt(1 - the sum of their squares).
"""

import numpy as np

# Indices of the other components, for each index of the largest one.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
MIN_LENGTH = 1e-12  # shorter quaternions are taken for zero


def normalize_quaternions(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [n, 4], float32; zero becomes the identity."""
    quats = np.asarray(quats, np.float32)
    largest = np.abs(quats).max(axis=1, keepdims=True)  # scaled to 1 first: squares of float32 may overflow
    quats = quats / np.where(largest > MIN_LENGTH, largest, 1)
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), MIN_LENGTH)
    unit[largest[:, 0] <= MIN_LENGTH] = 1, 0, 0, 0
    return unit


def smallest_three(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The index [n] of the largest component of each unit quaternion [n, 4], and the other three, [n, 3].

    The sign is chosen so that the largest component is positive. Works with any order of the components.
    """
    largest = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1, 1)
    return largest, sign * np.take_along_axis(unit, OTHERS[largest], axis=1)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The inverse of `smallest_three`: unit quaternions [n, 4], float32."""
    quats = np.empty((len(largest), 4), np.float32)
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(1 - np.square(others).sum(axis=1), 0))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats


def quaternions_to_matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [n, 3, 3], float64, of quaternions wxyz [n, 4] of any length; zero gives the identity."""
    quats = quats.astype(np.float64)
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)).T
    rotations = np.empty((len(quats), 3, 3))
    rotations[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    rotations[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    rotations[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return rotations


def matrices_to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [n, 4] of rotation matrices [n, 3, 3].

    Row i of the symmetric matrix below is 4 q_i (w, x, y, z); the longest row is the most accurate (Bar-Itzhack 2000).
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = np.moveaxis(rotations, 0, -1)
    rows = [
        [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
        [m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20],
        [m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12],
        [m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22],
    ]
    table = np.moveaxis(np.array(rows), -1, 0)  # [n, 4, 4]
    longest = np.linalg.norm(table, axis=2).argmax(axis=1)
    chosen = table[np.arange(len(table)), longest]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
