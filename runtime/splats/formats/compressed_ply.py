"""Gaussians as .compressed.ply files (PlayCanvas), a quarter to a tenth of the size of a .ply.

Chunks of 256 Gaussians in Morton order share their ranges: elements `chunk` (minima and maxima of positions, log scales
and colours), `vertex` (four packed 32-bit words for each Gaussian) and, with SH above degree 0, `sh`. The frame is that
of .ply files; the order of the Gaussians is not kept.

Precision, with the largest error: positions and log scales: 11, 10 and 11 bits of the chunk's range, 1/4094, 1/2046 and
1/4094 of it. colours: 8 bits, 1/510 of the range. opacities: 8 bits, 1/510. rotations: 10 bits for each of the
quaternion's smallest three components, 7e-4 each. SH of degree 1 to 3: 8 bits, 1/64 from -4 to 4, and 1/32 at the
limits. scales: from e^-20 to e^20.
"""

from io import BytesIO
from math import ceil
from pathlib import Path

import numpy as np

from ...errors import raise_input_error
from ...geometry.quaternions import from_smallest_three, normalize_quaternions, smallest_three
from ...geometry.sh import SH_0
from ...system.files import atomic_write, read_bytes
from ..gaussians import Gaussians, check_finite, check_ranges
from .encoding import clipped_note
from .morton import morton_order
from .ply_header import LIST, Element, offset_comment, read_header

CHUNK = 256  # Gaussians
RANGES = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))  # of a chunk
CHUNK_PROPERTIES = [f"{end}_{name}" for names in RANGES for end in ("min", "max") for name in names]
WITHOUT_COLOURS = CHUNK_PROPERTIES[:12]  # older files, in which colours range from 0 to 1
VERTEX_PROPERTIES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
POSITION_BITS = (11, 10, 11)  # of scales, too; the first component is in the highest bits
COLOUR_BITS = (8, 8, 8, 8)
ROTATION_BITS = (10, 10, 10)  # below two bits for the index of the largest component
LOG_SCALE_LIMIT = 20
SH_LIMIT = 4
EXPECTED = "a splat file (.compressed.ply)"
REMEDY = "expected PlayCanvas' compressed .ply; write it again"


def write_compressed_ply(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .compressed.ply; the file is replaced atomically.

    offset: what was subtracted from the world coordinates, [3], which a comment records.
    Returns a line for each thing that the format cannot hold. Raises InputError if a value is not finite or not in our
    units, or the file cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    order = morton_order(gaussians.means)
    log_scales = np.log(np.clip(gaussians.scales[order], np.exp(-LOG_SCALE_LIMIT), np.exp(LOG_SCALE_LIMIT)))
    means, mean_ranges = _in_chunks(gaussians.means[order])
    scales, scale_ranges = _in_chunks(log_scales)
    colours, colour_ranges = _in_chunks(gaussians.colours[order])
    words = [
        _pack(means, POSITION_BITS),
        _pack_rotations(gaussians.quats[order]),
        _pack(scales, POSITION_BITS),
        _pack(np.column_stack([colours, gaussians.opacities[order]]), COLOUR_BITS),
    ]
    chunks = np.stack([mean_ranges, scale_ranges, colour_ranges], axis=1).astype("<f4")  # [chunks, 3, 2, 3]
    rest = gaussians.sh[order, 1:].transpose(0, 2, 1)  # [gaussians, 3, coefficients]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        comment = "" if offset is None else offset_comment(offset)
        file.write(_header(len(chunks), len(gaussians), rest[0].size if len(rest) else 0, comment).encode("ascii"))
        file.write(chunks.tobytes())
        file.write(np.stack(words, axis=1).astype("<u4").tobytes())
        file.write(np.clip((rest / (2 * SH_LIMIT) + 0.5) * 256, 0, 255).astype(np.uint8).tobytes())
    notes = clipped_note("scales", gaussians.scales, np.exp(-LOG_SCALE_LIMIT), np.exp(LOG_SCALE_LIMIT))
    return notes + clipped_note("SH coefficients", rest, -SH_LIMIT, SH_LIMIT)


def read_compressed_ply(path: Path) -> Gaussians:
    """Read a .compressed.ply; raises InputError if the file cannot be read, is not one, or is damaged."""
    tables = _read_tables(path, read_bytes(path, EXPECTED))
    chunks, vertices = tables["chunk"], tables["vertex"]
    ranges = _ranges(chunks)
    rgba = _unpack(vertices["packed_color"], COLOUR_BITS)
    with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which are checked for below
        colours = _within(rgba[:, :3], ranges[2])
        gaussians = Gaussians(
            means=_within(_unpack(vertices["packed_position"], POSITION_BITS), ranges[0]).astype(np.float32),
            scales=np.exp(_within(_unpack(vertices["packed_scale"], POSITION_BITS), ranges[1])).astype(np.float32),
            quats=_unpack_rotations(vertices["packed_rotation"]),
            opacities=rgba[:, 3].astype(np.float32),
            sh=_sh((colours - 0.5) / SH_0, tables.get("sh")),
        )
    check_finite(path, gaussians)
    return gaussians


def _ranges(chunks: np.ndarray) -> list[np.ndarray]:
    """Minima and maxima of positions, log scales and colours, [chunks, 6] each."""
    names = chunks.dtype.names or ()
    columns = {name: chunks[name] for name in names}
    if "min_r" not in names:
        columns |= {name: np.full(len(chunks), float(name.startswith("max"))) for name in CHUNK_PROPERTIES[12:]}
    return [np.stack([columns[name] for name in CHUNK_PROPERTIES[at : at + 6]], axis=1) for at in (0, 6, 12)]


def _header(chunks: int, vertices: int, sh_values: int, comment: str) -> str:
    lines = ["ply", "format binary_little_endian 1.0", *comment.splitlines(), f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in CHUNK_PROPERTIES]
    lines += [f"element vertex {vertices}", *(f"property uint {name}" for name in VERTEX_PROPERTIES)]
    if sh_values:
        lines += [f"element sh {vertices}", *(f"property uchar f_rest_{index}" for index in range(sh_values))]
    return "\n".join([*lines, "end_header", ""])


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values [gaussians, 3] as fractions of their chunk's range, and the ranges [chunks, 2, 3]."""
    count, chunks = len(values), ceil(len(values) / CHUNK)
    padded = np.pad(values, ((0, chunks * CHUNK - count), (0, 0)), mode="edge" if count else "constant")
    padded = padded.reshape(chunks, CHUNK, 3).astype(np.float64)
    low, high = padded.min(axis=1, keepdims=True), padded.max(axis=1, keepdims=True)
    fractions = (padded - low) / np.where(high > low, high - low, 1)
    return fractions.reshape(-1, 3)[:count], np.concatenate([low, high], axis=1)


def _within(fractions: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """The inverse of `_in_chunks`: values from fractions [gaussians, 3] of the ranges [chunks, 6]."""
    low, high = (np.repeat(ends, CHUNK, axis=0)[: len(fractions)] for ends in np.split(ranges.astype(np.float64), 2, 1))
    return low * (1 - fractions) + high * fractions


def _pack(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers in [0, 1], [gaussians, components], in one word each, the first in the highest bits."""
    packed = np.zeros(len(fractions), np.uint32)
    for part, width in zip(fractions.T, bits, strict=True):
        packed = packed << width | np.rint(part * ((1 << width) - 1)).astype(np.uint32)
    return packed


def _unpack(packed: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """The inverse of `_pack`, float64 [gaussians, components]; higher bits are ignored."""
    parts = []
    for width in reversed(bits):
        parts.append((packed & ((1 << width) - 1)) / ((1 << width) - 1))
        packed = packed >> width
    return np.stack(parts[::-1], axis=1)


def _pack_rotations(quats: np.ndarray) -> np.ndarray:
    """Smallest three of wxyz: the index of the largest in the upper two bits, then the others, within sqrt(1/2)."""
    largest, others = smallest_three(normalize_quaternions(quats))
    fractions = np.clip(others * np.sqrt(0.5) + 0.5, 0, 1)
    return largest.astype(np.uint32) << sum(ROTATION_BITS) | _pack(fractions, ROTATION_BITS)


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    others = (_unpack(packed, ROTATION_BITS) - 0.5) * np.sqrt(2)
    return from_smallest_three(packed >> sum(ROTATION_BITS), others)


def _sh(constant: np.ndarray, rows: np.ndarray | None) -> np.ndarray:
    """SH coefficients [gaussians, coefficients, 3] from those of degree 0 [gaussians, 3] and the element `sh`."""
    names = () if rows is None else rows.dtype.names or ()
    rest = len(names) // 3
    sh = np.empty((len(constant), 1 + rest, 3), np.float32)
    sh[:, 0] = constant
    values = np.arange(256) + 0.5
    values[[0, 255]] = 0, 256  # the first and last byte stand for the limits
    values = (values / 256 - 0.5) * 2 * SH_LIMIT
    if rows is not None:
        for index, name in enumerate(names):  # all of red, then green, then blue
            sh[:, 1 + index % rest, index // rest] = values[rows[name]]
    return sh


def _read_tables(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """The rows of the elements as structured arrays, by name, checked against the layout."""
    file = BytesIO(content)
    elements, offset = read_header(file, path)
    _check_elements(path, {element.name: element for element in elements})
    tables = {}
    for element in elements:
        if LIST in element.properties.values():
            raise_input_error(path, f"element {element.name} has a list property", REMEDY)
        if not element.properties:
            continue
        row, end = element.row, offset + element.length * element.row.itemsize
        if len(content) < end:
            raise_input_error(
                path,
                f"cut short: {element.length} rows of {element.name} need {end} bytes, the file has {len(content)}",
                "copy or download it again",
            )
        tables[element.name] = np.frombuffer(content, row, element.length, offset)
        offset = end
    return tables


def _check_elements(path: Path, elements: dict[str, Element]) -> None:
    """Raise InputError for elements with other properties than the layout's, or lengths that do not agree."""
    for name in ("chunk", "vertex"):
        if name not in elements:
            raise_input_error(path, f"no element {name}", REMEDY)
    chunk, vertex = elements["chunk"], elements["vertex"]
    if chunk.properties not in [dict.fromkeys(names, "<f4") for names in (CHUNK_PROPERTIES, WITHOUT_COLOURS)]:
        raise_input_error(path, "element chunk has other properties than the format's", REMEDY)
    if vertex.properties != dict.fromkeys(VERTEX_PROPERTIES, "<u4"):
        raise_input_error(path, "element vertex has other properties than the format's", REMEDY)
    if chunk.length != ceil(vertex.length / CHUNK):
        raise_input_error(
            path, f"{chunk.length} chunks for {vertex.length} Gaussians", f"expected one for every {CHUNK}"
        )
    if "sh" in elements:
        sh = elements["sh"]
        if len(sh.properties) not in (9, 24, 45) or sh.length != vertex.length:
            raise_input_error(
                path, f"{sh.length} rows of {len(sh.properties)} SH coefficients", "expected 9, 24 or 45 each"
            )
        if sh.properties != {f"f_rest_{index}": "<u1" for index in range(len(sh.properties))}:
            raise_input_error(path, "element sh has other properties than the format's", REMEDY)
