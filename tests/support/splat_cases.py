"""The scene that splat files are tried with, and how far each format may move it."""

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from idesplat.runtime.geometry.quaternions import normalize_quaternions
from idesplat.runtime.splats.gaussians import Gaussians

DATA = Path(__file__).parent.parent / "data" / "splats"
ARRAYS = ("means", "scales", "quats", "opacities", "sh")


SORTED = (".compressed.ply", ".sog")  # these order Gaussians by place
NEVER_EMPTY = (".splat", ".glb", ".sog")


class Bounds(NamedTuple):
    """How far a format may move each kind of number."""

    means: tuple[float, float, float] = (0, 0, 0)
    log_scales: float = 0
    quats: float = 0
    opacities: float = 0
    colours: float = 0
    sh: float = 0  # degree 1 and above


def load_truth() -> Gaussians:
    """270 Gaussians, with spherical harmonics of degree 2, that the files in tests/data/splats hold."""
    with np.load(DATA / "scene.npz") as file:
        return Gaussians(**{name: file[name] for name in ARRAYS})


def box(truth: Gaussians, *steps: int) -> tuple[float, ...]:
    """Half a step of each coordinate where the scene's extent is divided into so many."""
    return tuple(np.ptp(truth.means, axis=0) / (2 * np.array(steps)))


def our_bounds(suffix: str, truth: Gaussians) -> Bounds:
    """The error bounds that the module of each format documents; 1e-6 for float32."""
    # The largest part of a quaternion is the root of what the smallest leave: it is off by up to three times as much.
    smallest_three_bound = 3 * 7e-4
    match suffix:
        case ".ply":
            return Bounds(log_scales=4e-6, opacities=1e-6)
        case ".compressed.ply":
            scale_range = float(np.ptp(np.log(truth.scales), axis=0).max())
            colour_range = float(np.ptp(truth.colours, axis=0).max())
            means = box(truth, 2047, 1023, 2047)
            return Bounds(means, scale_range / 2046, smallest_three_bound, 1 / 510, colour_range / 510, 1 / 64)
        case ".splat":
            return Bounds(quats=1 / 64, opacities=1 / 510, colours=1 / 510, log_scales=1e-6)
        case ".spz":
            means = (2.0**-20,) * 3  # 9 units and the sign take 5 of 24 bits
            return Bounds(means, 1 / 32, smallest_three_bound, 1 / 510, 1 / 271, 1 / 256)
        case ".sog":
            logs = np.ptp(np.sign(truth.means) * np.log1p(np.abs(truth.means)), axis=0)
            means = tuple(logs / (2 * 65535) * (1 + np.abs(truth.means).max(axis=0)))
            return Bounds(
                means,
                float(np.ptp(np.log(truth.scales))) / 256,
                3 * 2.8e-3,
                1 / 510,
                float(np.ptp(truth.colours)) / 256,
                float(np.ptp(truth.sh[:, 1:])) / 256 if truth.sh_degree else 0,
            )
        case ".glb":
            return Bounds()
    raise AssertionError(suffix)


def assert_close(back: Gaussians, truth: Gaussians, bounds: Bounds, in_order: bool = True) -> None:
    """The same Gaussians, whatever sign their quaternions have."""
    assert len(back) == len(truth)
    if not in_order:
        distance = np.linalg.norm(back.means[:, None] - truth.means[None], axis=-1)
        order = distance.argmin(axis=1)
        assert sorted(order) == list(range(len(truth)))
        truth = Gaussians(*(getattr(truth, name)[order] for name in ARRAYS))
    for name in ARRAYS:
        assert getattr(back, name).dtype == np.float32
    rounding = 2e-6
    assert (np.abs(back.means - truth.means).max(axis=0) <= np.array(bounds.means) + rounding * 10).all()
    np.testing.assert_allclose(np.log(back.scales), np.log(truth.scales), atol=bounds.log_scales + rounding)
    assert ellipsoid_turns(back.quats, truth.quats).max() <= bounds.quats + rounding
    np.testing.assert_allclose(back.opacities, truth.opacities, atol=bounds.opacities + rounding)
    np.testing.assert_allclose(back.colours, truth.colours, atol=bounds.colours + rounding)
    if back.sh_degree:
        np.testing.assert_allclose(back.sh[:, 1:], truth.sh[:, 1:], atol=bounds.sh + rounding)


def ellipsoid_turns(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """How far rotations differ in a part of their quaternion, [n]; an ellipsoid's own half turns make no difference."""
    ours, theirs = normalize_quaternions(ours), normalize_quaternions(theirs)
    w, x, y, z = theirs.T
    same = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    differences = [np.abs(ours - sign * np.stack(quat, axis=1)).max(axis=1) for quat in same for sign in (1, -1)]
    return np.min(differences, axis=0)


def without_bands(gaussians: Gaussians, degree: int) -> Gaussians:
    """The Gaussians with the SH coefficients up to a degree."""
    arrays = [getattr(gaussians, name).copy() for name in ARRAYS]
    return Gaussians(*arrays[:-1], np.ascontiguousarray(arrays[-1][:, : (degree + 1) ** 2]))


def highest_degree(suffix: str) -> int:
    """The highest SH degree that a format holds."""
    return 0 if suffix == ".splat" else 3


def gzipped(content: bytes) -> bytes:
    """The content compressed as a gzip stream."""
    compressor = zlib.compressobj(wbits=31)
    return compressor.compress(content) + compressor.flush()


def spz_header(
    count: int = 0, version: int = 3, degree: int = 0, bits: int = 12, flags: int = 0, magic: bytes = b"NGSP"
) -> bytes:
    """The header of an .spz file, before compression."""
    numbers = np.array([version, count], "<u4").tobytes() + bytes([degree, bits, flags, 0])
    return magic + numbers


def glb(content: bytes, change: Callable[[dict], None]) -> bytes:
    """A .glb whose JSON something was done to."""
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    sizes = np.array([2, 20 + len(text) + len(rest), len(text)], "<u4").tobytes()
    return b"glTF" + sizes + b"JSON" + text + rest
