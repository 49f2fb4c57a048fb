"""Gaussians as .splat files (antimatter15/splat): 32 bytes each, without a header.

Means and scales as float32, colour and opacity in 8 bits each, the rotation as a wxyz quaternion in 8 bits a component
around 128. The frame is the one of .ply files. Errors are at most 1/510 for colours and opacities and 1/64 for the
components of the unit quaternion. Colours outside [0, 1] are clipped, and SH above degree 0 is lost.
"""

from pathlib import Path

import numpy as np

from ...errors import InputError, raise_input_error
from ...geometry.quaternions import normalize_quaternions
from ...system.files import atomic_write, read_bytes
from ..gaussians import Gaussians, check_finite, check_ranges, with_colours
from .encoding import clipped_note, lost_offset, round_to_uint8

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
QUAT_ZERO, QUAT_STEPS = 128, 128  # byte = component * 128 + 128


def write_splat(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .splat; the file is replaced atomically.

    Returns a line for each thing that the format cannot hold. Raises InputError if a value is not finite or not in our
    units, or the file cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    if not len(gaussians):
        raise InputError(f"cannot write {path}: there are no Gaussians, and a .splat without any is an empty file")
    records = np.empty(len(gaussians), RECORD)
    records["mean"] = gaussians.means
    records["scale"] = gaussians.scales
    records["rgba"][:, :3] = round_to_uint8(gaussians.colours * 255)
    records["rgba"][:, 3] = round_to_uint8(gaussians.opacities * 255)
    records["quat"] = round_to_uint8(normalize_quaternions(gaussians.quats) * QUAT_STEPS + QUAT_ZERO)
    with atomic_write(path) as temporary:
        temporary.write_bytes(records.tobytes())
    lost = ["SH coefficients above degree 0 were left out"] if gaussians.sh_degree else []
    return lost + clipped_note("colours", gaussians.colours, 0, 1) + lost_offset(offset)


def read_splat(path: Path) -> Gaussians:
    """Read a .splat; raises InputError if the file cannot be read, is not one, or holds a value that is not finite."""
    content = read_bytes(path, "a splat file (.splat)")
    if len(content) % RECORD.itemsize:
        raise_input_error(
            path, f"{len(content)} bytes long", "a .splat has 32 bytes for each Gaussian; copy or download it again"
        )
    records = np.frombuffer(content, RECORD)
    if (records["scale"] < 0).any():
        raise_input_error(path, "negative scales", "expected standard deviations; it is not a .splat file, or damaged")
    rgba = records["rgba"] / np.float32(255)
    quats = normalize_quaternions((records["quat"] - np.float32(QUAT_ZERO)) / QUAT_STEPS)
    gaussians = with_colours(records["mean"], records["scale"], quats, rgba[:, 3], rgba[:, :3])
    check_finite(path, gaussians)
    return gaussians
