"""Gaussians as .sog files (PlayCanvas, version 2): a zip archive of lossless WebP pictures, one pixel a Gaussian.

The frame is the one of .ply files; the order of the Gaussians is not kept.

positions: 16 bits of sign(x) log(1 + |x|), so within half of 1/65535 of its range times 1 + |x|. rotations: 8 bits for
each of the smallest three parts of the quaternion, each within 2.8e-3. opacities: within 1/510. log scales, the first
spherical harmonic, and the others: each one of 256 numbers, within 1/256 of their range and closer where most lie. The
higher harmonics of a scene of more than 4,096 Gaussians are those of the most similar of 4,096 sets.
"""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, raise_input_error
from ...geometry.quaternions import from_smallest_three, normalize_quaternions, smallest_three
from ...system.files import atomic_write, check_expansion, read_bytes
from ..gaussians import Gaussians, bytes_in_memory, check_finite, check_ranges
from .codebooks import ENTRIES, build_codebook, cluster_vectors, quantize
from .encoding import round_to_uint8
from .morton import morton_order
from .ply_header import OFFSET, checked_offset

VERSION = 2
META = "meta.json"
EXPECTED = "a splat file (.sog)"
POSITION_STEPS = (1 << 16) - 1
QUAT_STEPS = 255 / np.sqrt(2)  # a smallest part lies within sqrt(1/2)
LARGEST_PART = 252  # alpha of the rotations' pixels: this and the place of the largest part of wxyz
SETS_A_ROW = 64  # of spherical harmonics in the palette's picture
MOST_SETS = 1 << 16
MIN_SCALE = 1e-30  # a logarithm must be finite
LOSSLESS = 101  # OpenCV's quality above 100
SIDE_STEP = 4  # sides of the pictures are multiples of it
MOST_META_BYTES = 1 << 22
# A lossless WebP: RIFF, its length, "WEBPVP8L", the chunk's length, a signature and the sides less one in 14 bits each.
WEBP = struct.Struct("<4sI8sIBI")
WEBP_SIGNATURE = 0x2F


def write_sog(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .sog; the file appears whole or not at all.

    offset: what was subtracted from the world coordinates, [3], which `asset` in meta.json records.
    Returns a line for each thing that the format cannot hold. Raises InputError if a value is not finite or not in our
    units, or the file cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    if not len(gaussians):
        raise InputError(f"cannot write {path}: there are no Gaussians, and a .sog knows no empty pictures")
    gaussians = gaussians.select(morton_order(gaussians.means))
    files: dict[str, bytes] = {}
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": "idesplat"}, "count": len(gaussians)}
    if offset is not None and offset.any():
        meta["asset"][OFFSET] = offset.tolist()

    logs = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * POSITION_STEPS).astype(np.uint16)
    files["means_l.webp"], files["means_u.webp"] = _picture(steps & 0xFF), _picture(steps >> 8)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}

    log_scales = np.log(np.maximum(gaussians.scales, MIN_SCALE))
    files["scales.webp"], meta["scales"] = _coded(log_scales, "scales.webp")
    largest, others = smallest_three(normalize_quaternions(gaussians.quats))
    files["quats.webp"] = _picture(
        np.column_stack([round_to_uint8(others * QUAT_STEPS + 127.5), LARGEST_PART + largest])
    )
    meta["quats"] = {"files": ["quats.webp"]}
    opacities = round_to_uint8(gaussians.opacities * 255)
    files["sh0.webp"], meta["sh0"] = _coded(gaussians.sh[:, 0], "sh0.webp", opacities)
    if gaussians.sh_degree:
        pictures, meta["shN"] = _harmonics(gaussians.sh[:, 1:], gaussians.sh_degree)
        files |= pictures

    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in {**files, META: json.dumps(meta).encode()}.items():
            archive.writestr(
                zipfile.ZipInfo(name), content
            )  # without the time, so that the same scene is the same file
    return []


def read_sog(path: Path) -> Gaussians:
    """Read a .sog; raises InputError if the file cannot be read, is not of version 2, or is damaged."""
    with _opened(path) as reader:
        gaussians = reader.read()
    check_finite(path, gaussians)
    return gaussians


def sog_offset(path: Path) -> np.ndarray:
    """What a .sog says was subtracted from its coordinates, float64 [3]; zeros where it says nothing.

    Raises InputError as `read_sog`.
    """
    with _opened(path) as reader:
        asset = reader.meta.get("asset")
    found = asset.get(OFFSET) if isinstance(asset, dict) else None
    return np.zeros(3) if found is None else checked_offset(path, found)


@contextmanager
def _opened(path: Path) -> Iterator["_Reader"]:
    """A reader of the archive; InputError is raised for whatever goes wrong inside the block, too."""
    content = read_bytes(path, EXPECTED)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            yield _Reader(path, archive, len(content))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, struct.error):
        raise_input_error(path, "not a zip archive, or damaged", f"expected {EXPECTED}")
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise_input_error(
            path, f"not a .sog as it should be ({type(error).__name__}: {str(error)[:60]})", "write it again"
        )


def _coded(values: np.ndarray, name: str, alpha: np.ndarray | None = None) -> tuple[bytes, dict[str, Any]]:
    """Values [gaussians, 3] as a picture of indices, and what meta.json says of it."""
    book = build_codebook(values)
    indices = quantize(values, book)
    return _picture(indices if alpha is None else np.column_stack([indices, alpha])), {
        "codebook": book.tolist(),
        "files": [name],
    }


def _harmonics(rest: np.ndarray, degree: int) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Spherical harmonics [gaussians, coefficients, 3] as a picture of sets and one of which set is whose."""
    count, coefficients, _ = rest.shape
    sets, labels = cluster_vectors(rest.reshape(count, -1))
    book = build_codebook(sets)
    indices = quantize(sets, book).reshape(len(sets), coefficients, 3)
    rows = ceil(len(sets) / SETS_A_ROW)
    table = np.zeros((rows * SETS_A_ROW, coefficients, 3), np.uint8)
    table[: len(sets)] = indices
    files = {
        "shN_centroids.webp": _encoded(table.reshape(rows, SETS_A_ROW * coefficients, 3)),
        "shN_labels.webp": _picture(np.column_stack([labels & 0xFF, labels >> 8, np.zeros_like(labels)])),
    }
    return files, {"count": len(sets), "bands": degree, "codebook": book.tolist(), "files": list(files)}


def _picture(pixels: np.ndarray) -> bytes:
    """Bytes [gaussians, 3 or 4] row by row in a picture that is about square."""
    width = ceil(sqrt(len(pixels)) / SIDE_STEP) * SIDE_STEP
    height = ceil(len(pixels) / width / SIDE_STEP) * SIDE_STEP
    whole = np.zeros((height * width, pixels.shape[1]), np.uint8)
    whole[: len(pixels)] = pixels
    return _encoded(whole.reshape(height, width, -1))


def _encoded(rgba: np.ndarray) -> bytes:
    """A picture [height, width, 3 or 4] as lossless WebP; the colours of pixels with alpha 0 may be lost."""
    import cv2

    order = [2, 1, 0, 3][: rgba.shape[2]]
    return cv2.imencode(".webp", np.ascontiguousarray(rgba[..., order]), [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])[
        1
    ].tobytes()


class _Reader:
    """One archive, whose sizes are checked before anything is unpacked."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, size: int) -> None:
        self.path, self.archive = path, archive
        entries = archive.infolist()
        for entry in entries:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
                raise_input_error(
                    path, f"{entry.filename[:60]} is encrypted or compressed in a rare way", "write it without"
                )
        check_expansion(path, sum(entry.file_size for entry in entries), size)
        if archive.getinfo(META).file_size > MOST_META_BYTES:
            raise_input_error(path, f"{META} is larger than {MOST_META_BYTES} bytes", "write it again")
        try:
            self.meta = json.loads(self._unpacked(META))
        except (ValueError, RecursionError):
            raise_input_error(path, f"{META} is not valid JSON", "copy or download it again")
        if self.meta["version"] != VERSION:
            raise_input_error(
                path, f"version {str(self.meta['version'])[:20]}", f"expected {VERSION}; convert it to that"
            )
        self.count = self.meta["count"]
        if type(self.count) is not int or self.count < 1:
            raise_input_error(path, f"count is {str(self.count)[:20]}", "expected the number of Gaussians")
        check_expansion(path, bytes_in_memory(self.count, self._degree()), size)

    def _degree(self) -> int:
        """Degree of the spherical harmonics."""
        if "shN" not in self.meta:
            return 0
        bands: int = self.meta["shN"]["bands"]
        if bands not in (1, 2, 3):
            raise_input_error(self.path, f"harmonics of degree {str(bands)[:20]}", "expected 1 to 3; write it again")
        return bands

    def _unpacked(self, name: str) -> bytes:
        """A file of the archive; never more bytes than the archive's directory says, which are checked."""
        with self.archive.open(name) as file:
            return file.read(self.archive.getinfo(name).file_size)

    def read(self) -> Gaussians:
        """All that the archive holds."""
        lower, upper = (self._pixels("means", index)[:, :3].astype(np.float64) for index in (0, 1))
        low, high = (self._numbers("means", end, 3) for end in ("mins", "maxs"))
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which are refused later
            logs = low + (high - low) * ((lower + 256 * upper) / POSITION_STEPS)
        rotations, colours = self._pixels("quats"), self._pixels("sh0")
        for name, pixels in (("quats", rotations), ("sh0", colours)):
            if pixels.shape[1] != 4:
                raise_input_error(self.path, f"the picture of {name} has no alpha", "write it again")
        largest = rotations[:, 3].astype(np.int64) - LARGEST_PART
        if largest.min() < 0:
            raise_input_error(self.path, "a rotation does not say which of its parts is the largest", "write it again")
        others = (rotations[:, :3] - 127.5) / QUAT_STEPS
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which are refused later
            return Gaussians(
                means=(np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
                scales=np.exp(self._book("scales")[self._pixels("scales")[:, :3]]),
                quats=from_smallest_three(largest, others),
                opacities=colours[:, 3] / np.float32(255),
                sh=np.concatenate([self._book("sh0")[colours[:, None, :3]], self._harmonics()], axis=1),
            )

    def _harmonics(self) -> np.ndarray:
        """Spherical harmonics of degree 1 and above, [gaussians, coefficients, 3]."""
        if "shN" not in self.meta:
            return np.empty((self.count, 0, 3), np.float32)
        sets = self.meta["shN"]["count"]
        if type(sets) is not int or not 1 <= sets <= MOST_SETS:
            raise_input_error(
                self.path, f"{str(sets)[:20]} sets of harmonics", f"expected 1 to {MOST_SETS}; write it again"
            )
        coefficients = (self._degree() + 1) ** 2 - 1
        table = self._decoded("shN", 0, sets * coefficients)
        if table.shape[1] != SETS_A_ROW * coefficients:
            raise_input_error(self.path, f"the picture of harmonics is {table.shape[1]} pixels wide", "write it again")
        rows = self._pixels("shN", 1).astype(np.int64)
        labels = rows[:, 0] + 256 * rows[:, 1]
        if labels.max() >= sets:
            raise_input_error(self.path, f"a Gaussian has harmonics {labels.max()} of {sets}", "write it again")
        indices = table[..., :3].reshape(-1, coefficients, 3)
        return self._book("shN")[indices[labels]]

    def _book(self, field: str) -> np.ndarray:
        return self._numbers(field, "codebook", ENTRIES).astype(np.float32)

    def _numbers(self, field: str, name: str, count: int) -> np.ndarray:
        values = np.array(self.meta[field][name], np.float64)
        if values.shape != (count,):
            raise_input_error(self.path, f"{field}.{name} has shape {values.shape}", f"expected {count} numbers")
        return values

    def _pixels(self, field: str, index: int = 0) -> np.ndarray:
        """The pixels, [gaussians, 3 or 4], of one of a field's pictures."""
        picture = self._decoded(field, index, self.count)
        return picture.reshape(-1, picture.shape[2])[: self.count]

    def _decoded(self, field: str, index: int, pixels: int) -> np.ndarray:
        """One of a field's pictures, RGB or RGBA, which has about as many pixels as it must have."""
        import cv2

        name = self.meta[field]["files"][index]
        content = self._unpacked(name)
        _, _, kind, _, signature, sides = WEBP.unpack_from(content)
        width, height = (sides & 0x3FFF) + 1, (sides >> 14 & 0x3FFF) + 1
        if kind != b"WEBPVP8L" or signature != WEBP_SIGNATURE:
            raise_input_error(self.path, f"{str(name)[:60]} is not a lossless WebP picture", "write it again")
        if not pixels <= width * height <= 2 * pixels + (1 << 16):
            raise_input_error(self.path, f"{name} has {width}x{height} pixels for {pixels} values", "write it again")
        try:
            picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            picture = None
        if picture is None or picture.dtype != np.uint8 or picture.ndim != 3:
            raise_input_error(self.path, f"{name} is damaged", "copy or download it again")
        return picture[..., [2, 1, 0, 3][: picture.shape[2]]]
