"""Camera trajectories: interpolation between views, and orbits."""

import numpy as np

from ..errors import InputError


def interpolate_extrinsics(extrinsics: np.ndarray, frames: int) -> np.ndarray:
    """Camera-to-world poses [frames, 4, 4] on a smooth trajectory through poses [views, 4, 4].

    Frames are uniform in the spline parameter, in which views are at 0, 1, 2, .... Positions follow a uniform
    Catmull-Rom spline, which passes through every view; rotations are interpolated by slerp. One view gives a static
    camera. Raises InputError without a view or a frame.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.spatial.transform import Rotation, Slerp

    if len(extrinsics) == 0 or frames < 1:
        raise InputError(
            f"a trajectory of {frames} frames through {len(extrinsics)} views; expected at least one of each"
        )
    extrinsics = np.asarray(extrinsics, np.float64)
    if len(extrinsics) == 1:
        return np.repeat(extrinsics, frames, axis=0)

    views, times = np.arange(len(extrinsics)), np.linspace(0, len(extrinsics) - 1, frames)
    rotations, positions = Rotation.from_matrix(extrinsics[:, :3, :3]), extrinsics[:, :3, 3]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Slerp(views, rotations)(times).as_matrix()
    poses[:, :3, 3] = CubicHermiteSpline(views, positions, _catmull_rom_tangents(positions))(times)
    return poses


def _catmull_rom_tangents(points: np.ndarray) -> np.ndarray:
    """The tangents [points, 3] of the spline at its points [points, 3]: half the chord between the neighbouring points.

    Before the first and after the last point the points are extended linearly.
    """
    extended = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    return (extended[2:] - extended[:-2]) / 2


def orbit_extrinsics(start: np.ndarray, pivot: np.ndarray, axis: np.ndarray, degrees: float, frames: int) -> np.ndarray:
    """Poses [frames, 4, 4] of a camera that orbits an axis [3] through the pivot [3], from the pose `start` [4, 4].

    360 degrees are a full turn; for a smaller angle the camera swings by half of it to either side. Both are loops:
    the first frame can follow the last. Raises InputError without a frame or an angle in (0, 360].
    """
    from scipy.spatial.transform import Rotation

    if frames < 1 or not 0 < degrees <= 360:
        raise InputError(f"an orbit of {frames} frames over {degrees:g} degrees; expected one frame, 0 to 360 degrees")
    phase = np.arange(frames) / frames
    angles = np.radians(degrees * phase if degrees == 360 else degrees / 2 * np.sin(2 * np.pi * phase))
    rotations = Rotation.from_rotvec(angles[:, None] * axis / np.linalg.norm(axis)).as_matrix()  # [frames, 3, 3]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = rotations @ start[:3, :3]
    poses[:, :3, 3] = pivot + rotations @ (start[:3, 3] - pivot)
    return poses
