"""Unit quaternions, and their smallest three parts, from which compact formats rebuild the fourth."""

import numpy as np

# The three parts beside each largest one, in order.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
MIN_LENGTH = 1e-12  # below this a quaternion has no direction


def normalize_quaternions(quats: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [n, 4] of length 1, float32; zero, which says nothing, becomes no rotation."""
    quats = np.asarray(quats, np.float32)
    largest = np.abs(quats).max(axis=1, keepdims=True)  # first to about 1: the square of a float32 may overflow
    quats = quats / np.where(largest > MIN_LENGTH, largest, 1)
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), MIN_LENGTH)
    unit[largest[:, 0] <= MIN_LENGTH] = 1, 0, 0, 0
    return unit


def smallest_three(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which part of each unit quaternion [n, 4] is the largest, [n], and the others [n, 3] with that one positive.

    The others lie within sqrt(1/2). The order of the parts is the caller's; the same goes in and out.
    """
    largest = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1, 1)
    return largest, sign * np.take_along_axis(unit, OTHERS[largest], axis=1)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The unit quaternions [n, 4], float32, whose `smallest_three` these are."""
    quats = np.empty((len(largest), 4), np.float32)
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(1 - np.square(others).sum(axis=1), 0))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats


def quaternions_to_matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [n, 3, 3], float64, of quaternions wxyz [n, 4] of any length; zero means no rotation."""
    quats = quats.astype(np.float64)
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)).T
    rotations = np.empty((len(quats), 3, 3))
    rotations[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    rotations[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    rotations[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return rotations


def matrices_to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [n, 4] of rotation matrices [n, 3, 3].

    Each row of the symmetric matrix below is the quaternion times four of its parts; the longest row is the exactest.
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
