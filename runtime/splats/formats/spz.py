"""Gaussians as .spz files (nianticlabs/spz), some ten times smaller than .ply.

Version 3, a gzip stream, is written; versions 2 to 4 are read. A header, then all positions, opacities, colours,
scales, rotations and SH coefficients. The axes are OpenGL's (x right, y up, z backward), a rotation by 180 degrees
about x.

Precision, with the largest error: positions: 24-bit fixed point with as many fractional bits as the extent leaves,
2^-23 of the largest coordinate or 2^-25 units. opacities: 8 bits, 1/510. colours: 8 bits, 1/271, from -0.44 to 1.44.
scales: 8 bits of the logarithm, 3.2 %, from 4.5e-5 to 379. rotations: 10 bits for each of the quaternion's smallest
three components, 7e-4 each (version 2: 8 bits for each of x, y and z). SH of degree 1 to 3: 8 bits, 1/256, from -1 to
0.996.
"""

import zlib
from pathlib import Path

import numpy as np

from ...errors import raise_input_error
from ...geometry.quaternions import from_smallest_three, normalize_quaternions, smallest_three
from ...geometry.sh import SH_0
from ...system.files import atomic_write, read_bytes
from ..axes import OPENGL, convert_axes
from ..gaussians import Gaussians, check_finite, check_ranges
from .encoding import clipped_note, lost_offset, round_to_uint8
from .spz_container import EXPECTED, HEADER, MAGIC, MAX_FRACTIONAL_BITS, unpack

VERSION = 3  # that is written: not every viewer reads version 4 yet

POSITION_LIMIT = (1 << 23) - 1  # of 24 bits with a sign
LOG_SCALE_STEPS, LOG_SCALE_OFFSET = 16, 10  # byte = (log scale + 10) * 16
COLOUR_STEPS = 0.15 * 255  # byte = sh * COLOUR_STEPS + 127.5: a range wider than [0, 1]
SH_STEPS = 128  # byte = sh * 128 + 128
SH_HIGHEST = 127.5 / 128  # is rounded to 255
QUAT_STEPS = 511 / np.sqrt(0.5)  # magnitude of a component in 9 bits; the tenth is its sign


def write_spz(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .spz; the file is replaced atomically.

    Returns a line for each thing that the format cannot hold. Raises InputError if a value is not finite or not in our
    units, a coordinate is beyond the format's range, or the file cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    converted = convert_axes(gaussians, OPENGL)
    bits = _fractional_bits(path, converted.means)
    rest = converted.sh[:, 1:]
    with np.errstate(divide="ignore"):
        log_scales = np.log(converted.scales)
    parts = [
        HEADER.pack(MAGIC, VERSION, len(converted), converted.sh_degree, bits, 0, 0),
        _pack_positions(converted.means, bits),
        round_to_uint8(converted.opacities * 255),
        round_to_uint8(converted.sh[:, 0] * COLOUR_STEPS + 127.5),
        round_to_uint8((log_scales + LOG_SCALE_OFFSET) * LOG_SCALE_STEPS),
        _pack_rotations(converted.quats),
        round_to_uint8(rest * SH_STEPS + SH_STEPS),
    ]
    compressor = zlib.compressobj(wbits=31)  # gzip's header and trailer
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            file.write(compressor.compress(part if isinstance(part, bytes) else np.ascontiguousarray(part).data))
        file.write(compressor.flush())
    highest = np.exp(255 / LOG_SCALE_STEPS - LOG_SCALE_OFFSET)
    notes = clipped_note("scales", converted.scales, np.exp(-LOG_SCALE_OFFSET), highest)
    notes += clipped_note("SH coefficients", rest, -1, SH_HIGHEST)
    return notes + clipped_note("colours", gaussians.colours, *_colour_range()) + lost_offset(offset)


def read_spz(path: Path) -> Gaussians:
    """Read a .spz; raises InputError if the file cannot be read, is not one we know, or is damaged."""
    header, body = unpack(path, read_bytes(path, EXPECTED))
    count, coefficients = header.gaussians, (header.sh_degree + 1) ** 2
    fields, start = [], 0
    for size in header.sizes:
        fields.append(np.frombuffer(body, np.uint8, count * size, start).reshape(count, size))
        start += count * size
    positions, opacities, colours, scales, rotations, rest = fields
    sh = np.empty((count, coefficients, 3), np.float32)
    sh[:, 0] = (colours - np.float32(127.5)) / COLOUR_STEPS
    sh[:, 1:] = (rest.reshape(count, coefficients - 1, 3) - np.float32(SH_STEPS)) / SH_STEPS
    unpack_rotations = _unpack_version_2_rotations if header.version == 2 else _unpack_rotations
    gaussians = Gaussians(
        means=_unpack_positions(positions, header.fractional_bits),
        scales=np.exp(scales / np.float32(LOG_SCALE_STEPS) - LOG_SCALE_OFFSET),
        quats=unpack_rotations(rotations),
        opacities=opacities[:, 0] / np.float32(255),
        sh=sh,
    )
    return convert_axes(gaussians, OPENGL)


def _fractional_bits(path: Path, means: np.ndarray) -> int:
    """The most fractional bits with which the largest coordinate fits 24 bits."""
    largest = float(np.abs(means).max(initial=0))
    if largest > POSITION_LIMIT:
        raise_input_error(
            path, f"the scene reaches {largest:g} units", f"a .spz holds {POSITION_LIMIT}; write a .ply instead"
        )
    bits = MAX_FRACTIONAL_BITS
    while round(largest * 2**bits) > POSITION_LIMIT:
        bits -= 1
    return bits


def _pack_positions(means: np.ndarray, bits: int) -> np.ndarray:
    """24-bit fixed-point numbers, little endian, uint8 [gaussians, 3, 3]."""
    fixed = np.rint(means.astype(np.float64) * 2**bits).astype("<i4", order="C")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3]


def _unpack_positions(packed: np.ndarray, bits: int) -> np.ndarray:
    fixed = np.zeros((len(packed), 3, 4), np.uint8)
    fixed[..., 1:] = packed.reshape(-1, 3, 3)  # in the upper bytes, so that the right shift extends the sign
    return ((fixed.view("<i4")[..., 0] >> 8) / 2**bits).astype(np.float32)


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    """Smallest three of xyzw: the index of the largest in 2 bits, then the others as sign and 9-bit magnitude."""
    largest, others = smallest_three(np.roll(normalize_quaternions(quats), -1, axis=1))
    packed = largest.astype("<u4")
    for part in others.T:
        magnitude = np.rint(np.abs(part) * QUAT_STEPS).astype("<u4")
        packed = packed << 10 | (part < 0).astype("<u4") << 9 | magnitude
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([words >> 20, words >> 10, words], axis=1) & 0x3FF
    others = (fields & 0x1FF) / QUAT_STEPS * np.where(fields & 0x200, -1, 1)
    return np.roll(from_smallest_three(words >> 30, others), 1, axis=1)


def _unpack_version_2_rotations(packed: np.ndarray) -> np.ndarray:
    """Version 2: x, y and z in 8 bits each; w = sqrt(1 - x^2 - y^2 - z^2)."""
    xyz = packed / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _colour_range() -> tuple[float, float]:
    """The colours of the bytes 0 and 255."""
    reach = SH_0 * 127.5 / COLOUR_STEPS
    return 0.5 - reach, 0.5 + reach
