"""Smooth camera paths through given views."""

import numpy as np

from ..errors import InputError


def interpolate_extrinsics(extrinsics: np.ndarray, frames: int) -> np.ndarray:
    """Poses [frames, 4, 4] on a smooth path through the views' camera-to-world poses [views, 4, 4], first to last.

    The same number of frames lies between any two neighbouring views. Positions follow a Catmull-Rom spline, which
    meets every view; orientations turn about one axis from view to view (slerp), the shorter way. One view gives a
    camera that stands still. Raises InputError if there is no view or no frame.
    """
    import cv2

    if len(extrinsics) == 0 or frames < 1:
        raise InputError(f"a camera path of {frames} frames through {len(extrinsics)} views; expected one of each")
    extrinsics = np.asarray(extrinsics, np.float64)
    if len(extrinsics) == 1:
        return np.repeat(extrinsics, frames, axis=0)

    times = np.linspace(0, len(extrinsics) - 1, frames)
    legs = np.minimum(times.astype(int), len(extrinsics) - 2)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, leg, share in zip(poses, legs, times - legs, strict=True):
        start, end = extrinsics[leg, :3, :3], extrinsics[leg + 1, :3, :3]
        turn, _ = cv2.Rodrigues(start.T @ end)  # axis times angle
        pose[:3, :3] = start @ cv2.Rodrigues(share * turn)[0]
        pose[:3, 3] = _catmull_rom(extrinsics[:, :3, 3], leg, share)
    return poses


def _catmull_rom(points: np.ndarray, leg: int, share: float) -> np.ndarray:
    """The point at `share` between points[leg] and the next; beyond the ends, points [points, 3] go on straight."""
    before = points[leg - 1] if leg > 0 else 2 * points[0] - points[1]
    start, end = points[leg], points[leg + 1]
    after = points[leg + 2] if leg + 2 < len(points) else 2 * points[-1] - points[-2]
    leaving, arriving = (end - before) / 2, (after - start) / 2  # velocities
    return (
        start
        + share * leaving
        + share**2 * (3 * (end - start) - 2 * leaving - arriving)
        + share**3 * (2 * (start - end) + leaving + arriving)
    )


def orbit_extrinsics(start: np.ndarray, pivot: np.ndarray, axis: np.ndarray, degrees: float, frames: int) -> np.ndarray:
    """Poses [frames, 4, 4] of a camera carried around an axis [3] through the pivot [3], beginning at `start` [4, 4].

    By 360 degrees it goes all the way round; by fewer it swings as far as half of them to either side and comes back.
    Either way the first frame could follow the last. Raises InputError if there is no frame or no angle.
    """
    import cv2

    if frames < 1 or not 0 < degrees <= 360:
        raise InputError(f"an orbit of {frames} frames over {degrees:g} degrees; expected one frame, 0 to 360 degrees")
    turns = np.arange(frames) / frames
    angles = np.radians(degrees * turns if degrees == 360 else degrees / 2 * np.sin(2 * np.pi * turns))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        turn = cv2.Rodrigues(angle * axis / np.linalg.norm(axis))[0]
        pose[:3, :3] = turn @ start[:3, :3]
        pose[:3, 3] = pivot + turn @ (start[:3, 3] - pivot)
    return poses
