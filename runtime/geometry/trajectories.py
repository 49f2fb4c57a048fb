"""Camera trajectories: interpolation between views, and orbits.

Own code instead of scipy's Slerp and CubicHermiteSpline: these round differently, and rendered frames are to stay
bit-identical.
"""

import numpy as np

from ..errors import InputError


def interpolate_extrinsics(extrinsics: np.ndarray, frames: int) -> np.ndarray:
    """Camera-to-world poses [frames, 4, 4] on a smooth trajectory through poses [views, 4, 4].

    Frames are uniform in the spline parameter, in which views are at 0, 1, 2, .... Positions follow a uniform
    Catmull-Rom spline, which passes through every view; rotations are interpolated by slerp. One view gives a static
    camera. Raises InputError without a view or a frame.
    """
    import cv2

    if len(extrinsics) == 0 or frames < 1:
        raise InputError(
            f"a trajectory of {frames} frames through {len(extrinsics)} views; expected at least one of each"
        )
    extrinsics = np.asarray(extrinsics, np.float64)
    if len(extrinsics) == 1:
        return np.repeat(extrinsics, frames, axis=0)

    times = np.linspace(0, len(extrinsics) - 1, frames)
    segments = np.minimum(times.astype(int), len(extrinsics) - 2)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, segment, t in zip(poses, segments, times - segments, strict=True):
        start, end = extrinsics[segment, :3, :3], extrinsics[segment + 1, :3, :3]
        rotation_vector, _ = cv2.Rodrigues(start.T @ end)
        pose[:3, :3] = start @ cv2.Rodrigues(t * rotation_vector)[0]  # slerp
        pose[:3, 3] = _catmull_rom(extrinsics[:, :3, 3], segment, t)
    return poses


def _catmull_rom(points: np.ndarray, segment: int, t: float) -> np.ndarray:
    """The spline through points [points, 3] at t in [0, 1] of a segment.

    A cubic Hermite spline, whose tangents are half the chord between the neighbouring points; before the first and
    after the last point it is extended linearly.
    """
    before = points[segment - 1] if segment > 0 else 2 * points[0] - points[1]
    start, end = points[segment], points[segment + 1]
    after = points[segment + 2] if segment + 2 < len(points) else 2 * points[-1] - points[-2]
    start_tangent, end_tangent = (end - before) / 2, (after - start) / 2
    return (
        start
        + t * start_tangent
        + t**2 * (3 * (end - start) - 2 * start_tangent - end_tangent)
        + t**3 * (2 * (start - end) + start_tangent + end_tangent)
    )


def orbit_extrinsics(start: np.ndarray, pivot: np.ndarray, axis: np.ndarray, degrees: float, frames: int) -> np.ndarray:
    """Poses [frames, 4, 4] of a camera that orbits an axis [3] through the pivot [3], from the pose `start` [4, 4].

    360 degrees are a full turn; for a smaller angle the camera swings by half of it to either side. Both are loops:
    the first frame can follow the last. Raises InputError without a frame or an angle in (0, 360].
    """
    import cv2

    if frames < 1 or not 0 < degrees <= 360:
        raise InputError(f"an orbit of {frames} frames over {degrees:g} degrees; expected one frame, 0 to 360 degrees")
    phase = np.arange(frames) / frames
    angles = np.radians(degrees * phase if degrees == 360 else degrees / 2 * np.sin(2 * np.pi * phase))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        rotation = cv2.Rodrigues(angle * axis / np.linalg.norm(axis))[0]
        pose[:3, :3] = rotation @ start[:3, :3]
        pose[:3, 3] = pivot + rotation @ (start[:3, 3] - pivot)
    return poses
