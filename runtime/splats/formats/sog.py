"""Gaussians as .sog files (PlayCanvas, version 2): a zip archive of lossless WebP images with one pixel per Gaussian.

The frame is that of .ply files; the order of the Gaussians is not kept.

Precision, with the largest error: positions: 16 bits of sign(x) log(1 + |x|), half of 1/65535 of its range times 1 +
|x|. rotations: 8 bits for each of the quaternion's smallest three components, 2.8e-3 each. opacities: 8 bits, 1/510.
log scales and SH: entries of codebooks of 256 numbers, 1/256 of their range and less where values are dense. With more
than 4,096 Gaussians, SH above degree 0 is vector quantised to 4,096 centroids.
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
QUAT_STEPS = 255 / np.sqrt(2)  # the smallest three components lie within sqrt(1/2)
LARGEST_COMPONENT = 252  # alpha of the rotations' pixels: this plus the index of the largest component of wxyz
CENTROIDS_PER_ROW = 64  # of the image of centroids
MAX_CENTROIDS = 1 << 16
MIN_SCALE = 1e-30  # logarithms must be finite
LOSSLESS = 101  # to OpenCV, a quality above 100
SIDE_MULTIPLE = 4  # of the images' sides
MAX_META_BYTES = 1 << 22
# A lossless WebP: RIFF, its length, "WEBPVP8L", the chunk's length, a signature and the sides less one in 14 bits each.
WEBP = struct.Struct("<4sI8sIBI")
WEBP_SIGNATURE = 0x2F


def write_sog(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .sog; the file is replaced atomically.

    offset: what was subtracted from the world coordinates, [3], which `asset` in meta.json records.
    Returns a line for each thing that the format cannot hold. Raises InputError if a value is not finite or not in our
    units, or the file cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    if not len(gaussians):
        raise InputError(f"cannot write {path}: there are no Gaussians, and a .sog has no empty images")
    gaussians = gaussians.select(morton_order(gaussians.means))
    files: dict[str, bytes] = {}
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": "idesplat"}, "count": len(gaussians)}
    if offset is not None and offset.any():
        meta["asset"][OFFSET] = offset.tolist()

    logs = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * POSITION_STEPS).astype(np.uint16)
    files["means_l.webp"], files["means_u.webp"] = _image(steps & 0xFF), _image(steps >> 8)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}

    log_scales = np.log(np.maximum(gaussians.scales, MIN_SCALE))
    files["scales.webp"], meta["scales"] = _quantized(log_scales, "scales.webp")
    largest, others = smallest_three(normalize_quaternions(gaussians.quats))
    files["quats.webp"] = _image(
        np.column_stack([round_to_uint8(others * QUAT_STEPS + 127.5), LARGEST_COMPONENT + largest])
    )
    meta["quats"] = {"files": ["quats.webp"]}
    opacities = round_to_uint8(gaussians.opacities * 255)
    files["sh0.webp"], meta["sh0"] = _quantized(gaussians.sh[:, 0], "sh0.webp", opacities)
    if gaussians.sh_degree:
        images, meta["shN"] = _sh(gaussians.sh[:, 1:], gaussians.sh_degree)
        files |= images

    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in {**files, META: json.dumps(meta).encode()}.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # without the time: the same scene gives the same file
    return []


def read_sog(path: Path) -> Gaussians:
    """Read a .sog; raises InputError if the file cannot be read, is not of version 2, or is damaged."""
    with _opened(path) as reader:
        gaussians = reader.read()
    check_finite(path, gaussians)
    return gaussians


def sog_offset(path: Path) -> np.ndarray:
    """The offset that a .sog records as subtracted from its coordinates, float64 [3]; zeros if none.

    Raises InputError as `read_sog`.
    """
    with _opened(path) as reader:
        asset = reader.meta.get("asset")
    found = asset.get(OFFSET) if isinstance(asset, dict) else None
    return np.zeros(3) if found is None else checked_offset(path, found)


@contextmanager
def _opened(path: Path) -> Iterator["_Reader"]:
    """A reader of the archive; errors of damaged files inside the block become InputError."""
    content = read_bytes(path, EXPECTED)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            yield _Reader(path, archive, len(content))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, struct.error):
        raise_input_error(path, "not a zip archive, or damaged", f"expected {EXPECTED}")
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise_input_error(path, f"invalid .sog ({type(error).__name__}: {str(error)[:60]})", "write it again")


def _quantized(values: np.ndarray, name: str, alpha: np.ndarray | None = None) -> tuple[bytes, dict[str, Any]]:
    """Values [gaussians, 3] as an image of codebook indices, and its entry in meta.json."""
    codebook = build_codebook(values)
    indices = quantize(values, codebook)
    return _image(indices if alpha is None else np.column_stack([indices, alpha])), {
        "codebook": codebook.tolist(),
        "files": [name],
    }


def _sh(rest: np.ndarray, degree: int) -> tuple[dict[str, bytes], dict[str, Any]]:
    """SH coefficients [gaussians, coefficients, 3] as an image of centroids and one of labels, and their entry."""
    count, coefficients, _ = rest.shape
    centroids, labels = cluster_vectors(rest.reshape(count, -1))
    codebook = build_codebook(centroids)
    indices = quantize(centroids, codebook).reshape(len(centroids), coefficients, 3)
    rows = ceil(len(centroids) / CENTROIDS_PER_ROW)
    table = np.zeros((rows * CENTROIDS_PER_ROW, coefficients, 3), np.uint8)
    table[: len(centroids)] = indices
    files = {
        "shN_centroids.webp": _webp(table.reshape(rows, CENTROIDS_PER_ROW * coefficients, 3)),
        "shN_labels.webp": _image(np.column_stack([labels & 0xFF, labels >> 8, np.zeros_like(labels)])),
    }
    return files, {"count": len(centroids), "bands": degree, "codebook": codebook.tolist(), "files": list(files)}


def _image(pixels: np.ndarray) -> bytes:
    """Bytes [gaussians, 3 or 4], row by row, as a WebP image that is about square."""
    width = ceil(sqrt(len(pixels)) / SIDE_MULTIPLE) * SIDE_MULTIPLE
    height = ceil(len(pixels) / width / SIDE_MULTIPLE) * SIDE_MULTIPLE
    whole = np.zeros((height * width, pixels.shape[1]), np.uint8)
    whole[: len(pixels)] = pixels
    return _webp(whole.reshape(height, width, -1))


def _webp(rgba: np.ndarray) -> bytes:
    """An image [height, width, 3 or 4] as lossless WebP; the colours of pixels with alpha 0 may be lost."""
    import cv2

    order = [2, 1, 0, 3][: rgba.shape[2]]
    return cv2.imencode(".webp", np.ascontiguousarray(rgba[..., order]), [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])[
        1
    ].tobytes()


class _Reader:
    """One archive, whose sizes are checked before anything is decompressed."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, size: int) -> None:
        self.path, self.archive = path, archive
        entries = archive.infolist()
        for entry in entries:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
                raise_input_error(
                    path, f"{entry.filename[:60]} is encrypted or compressed by an unusual method", "write it without"
                )
        check_expansion(path, sum(entry.file_size for entry in entries), size)
        if archive.getinfo(META).file_size > MAX_META_BYTES:
            raise_input_error(path, f"{META} is larger than {MAX_META_BYTES} bytes", "write it again")
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
        """SH degree."""
        if "shN" not in self.meta:
            return 0
        bands: int = self.meta["shN"]["bands"]
        if bands not in (1, 2, 3):
            raise_input_error(self.path, f"SH of degree {str(bands)[:20]}", "expected 1 to 3; write it again")
        return bands

    def _unpacked(self, name: str) -> bytes:
        """A file of the archive, up to the size in the archive's directory, which was checked."""
        with self.archive.open(name) as file:
            return file.read(self.archive.getinfo(name).file_size)

    def read(self) -> Gaussians:
        """The Gaussians of the archive."""
        lower, upper = (self._pixels("means", index)[:, :3].astype(np.float64) for index in (0, 1))
        low, high = (self._numbers("means", end, 3) for end in ("mins", "maxs"))
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which are checked for later
            logs = low + (high - low) * ((lower + 256 * upper) / POSITION_STEPS)
        rotations, colours = self._pixels("quats"), self._pixels("sh0")
        for name, pixels in (("quats", rotations), ("sh0", colours)):
            if pixels.shape[1] != 4:
                raise_input_error(self.path, f"the image of {name} has no alpha channel", "write it again")
        largest = rotations[:, 3].astype(np.int64) - LARGEST_COMPONENT
        if largest.min() < 0:
            raise_input_error(self.path, "a rotation without the index of its largest component", "write it again")
        others = (rotations[:, :3] - 127.5) / QUAT_STEPS
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which are checked for later
            return Gaussians(
                means=(np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
                scales=np.exp(self._codebook("scales")[self._pixels("scales")[:, :3]]),
                quats=from_smallest_three(largest, others),
                opacities=colours[:, 3] / np.float32(255),
                sh=np.concatenate([self._codebook("sh0")[colours[:, None, :3]], self._sh()], axis=1),
            )

    def _sh(self) -> np.ndarray:
        """SH coefficients of degree 1 and above, [gaussians, coefficients, 3]."""
        if "shN" not in self.meta:
            return np.empty((self.count, 0, 3), np.float32)
        count = self.meta["shN"]["count"]
        if type(count) is not int or not 1 <= count <= MAX_CENTROIDS:
            raise_input_error(
                self.path, f"{str(count)[:20]} centroids of SH", f"expected 1 to {MAX_CENTROIDS}; write it again"
            )
        coefficients = (self._degree() + 1) ** 2 - 1
        table = self._decoded("shN", 0, count * coefficients)
        if table.shape[1] != CENTROIDS_PER_ROW * coefficients:
            raise_input_error(self.path, f"the image of centroids is {table.shape[1]} pixels wide", "write it again")
        rows = self._pixels("shN", 1).astype(np.int64)
        labels = rows[:, 0] + 256 * rows[:, 1]
        if labels.max() >= count:
            raise_input_error(self.path, f"a Gaussian has the centroid {labels.max()} of {count}", "write it again")
        indices = table[..., :3].reshape(-1, coefficients, 3)
        return self._codebook("shN")[indices[labels]]

    def _codebook(self, field: str) -> np.ndarray:
        return self._numbers(field, "codebook", ENTRIES).astype(np.float32)

    def _numbers(self, field: str, name: str, count: int) -> np.ndarray:
        values = np.array(self.meta[field][name], np.float64)
        if values.shape != (count,):
            raise_input_error(self.path, f"{field}.{name} has shape {values.shape}", f"expected {count} numbers")
        return values

    def _pixels(self, field: str, index: int = 0) -> np.ndarray:
        """The pixels [gaussians, 3 or 4] of one of a field's images."""
        image = self._decoded(field, index, self.count)
        return image.reshape(-1, image.shape[2])[: self.count]

    def _decoded(self, field: str, index: int, pixels: int) -> np.ndarray:
        """One of a field's images, RGB or RGBA, once its size fits the number of pixels."""
        import cv2

        name = self.meta[field]["files"][index]
        content = self._unpacked(name)
        _, _, kind, _, signature, sides = WEBP.unpack_from(content)
        width, height = (sides & 0x3FFF) + 1, (sides >> 14 & 0x3FFF) + 1
        if kind != b"WEBPVP8L" or signature != WEBP_SIGNATURE:
            raise_input_error(self.path, f"{str(name)[:60]} is not a lossless WebP image", "write it again")
        if not pixels <= width * height <= 2 * pixels + (1 << 16):
            raise_input_error(self.path, f"{name} has {width}x{height} pixels for {pixels} values", "write it again")
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
        if image is None or image.dtype != np.uint8 or image.ndim != 3:
            raise_input_error(self.path, f"{name} is damaged", "copy or download it again")
        return image[..., [2, 1, 0, 3][: image.shape[2]]]
