"""Gaussians in the .ply layout of 3DGS (Kerbl et al. 2023), which every viewer reads.

One element `vertex`, binary little endian, float32: x y z, normals that are not used, SH of degree 0 as f_dc_*, of the
higher degrees as f_rest_* (all of red, then green, then blue), opacity as a logit, scales as logarithms, the rotation
as a wxyz quaternion. The frame is the scene's own, with OpenCV's axes.
"""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ...errors import InputError, raise_input_error
from ...system.files import atomic_write, open_regular
from ..gaussians import Gaussians, check_ranges
from .ply_header import LIST, Element, offset_comment, read_header

VERTICES_AT_ONCE = 1 << 13  # whose rows stay in the cache while columns are filled one by one
MIN_OPACITY = 1e-6  # logits must be finite: opacities are clipped to this distance from 0 and 1
MIN_SCALE = 1e-30  # logarithms must be finite


def write_ply(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a binary .ply; the file is replaced atomically.

    offset: what was subtracted from the world coordinates, [3], which a comment records.
    Opacities are clipped to 1e-6 from 0 and 1, so that their logits are finite. Returns no line: nothing is lost.
    Raises InputError if a value is not finite, a scale is negative, an opacity outside [0, 1], or the file cannot be
    written.
    """
    check_ranges(path, gaussians)
    names = list(_columns(gaussians))
    names[3:3] = ["nx", "ny", "nz"]  # gaussforge and some older viewers require normals
    properties = "".join(f"property float {name}\n" for name in names)
    comment = "" if offset is None else offset_comment(offset)
    element = f"element vertex {len(gaussians)}\n"
    header = f"ply\nformat binary_little_endian 1.0\n{comment}{element}{properties}end_header\n"
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        table = np.zeros((VERTICES_AT_ONCE, len(names)), "<f4")
        _reserve(file, len(header) + len(gaussians) * table.itemsize * len(names))
        file.write(header.encode("ascii"))
        for block in _blocks(len(gaussians)):
            rows = table[: block.stop - block.start]
            _encode(gaussians, block, rows)
            if not np.isfinite(rows).all():
                vertex, column = np.argwhere(~np.isfinite(rows))[0]
                raise InputError(
                    f"cannot write {path}: {names[column]} of Gaussian {block.start + vertex} is not finite; "
                    "leave that Gaussian out"
                )
            file.write(rows.data)
    return []


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS .ply: properties in any order, float or double, with or without normals; others are ignored.

    Raises InputError if the file cannot be read, is not such a file, is cut short, or holds a value that is not finite.
    """
    path = Path(path)
    try:
        with open_regular(path) as file:
            vertices = _find_vertices(file, path)
            return _read_vertices(file, path, vertices)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; expected a splat file (.ply)") from None


def _columns(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """A view of each column, [gaussians], by its name in the file, in the usual order."""
    sh = gaussians.sh
    rest = sh.shape[1] - 1
    columns = {name: gaussians.means[:, axis] for axis, name in enumerate("xyz")}
    columns |= {f"f_dc_{channel}": sh[:, 0, channel] for channel in range(3)}
    columns |= {f"f_rest_{index}": sh[:, 1 + index % rest, index // rest] for index in range(3 * rest)}
    columns["opacity"] = gaussians.opacities
    columns |= {f"scale_{axis}": gaussians.scales[:, axis] for axis in range(3)}
    columns |= {f"rot_{part}": gaussians.quats[:, part] for part in range(4)}
    return columns


def _blocks(count: int) -> Iterator[slice]:
    """Slices of 0 to count that fit the cache."""
    for start in range(0, count, VERTICES_AT_ONCE):
        yield slice(start, min(start + VERTICES_AT_ONCE, count))


def _reserve(file: BinaryIO, size: int) -> None:
    """Allocate the disk space at once where the system can: writing is three times faster than to a growing file."""
    if hasattr(os, "posix_fallocate"):
        with suppress(OSError):  # not every file system can; a full disk is noticed when it is written to
            os.posix_fallocate(file.fileno(), 0, size)


def _encode(gaussians: Gaussians, block: slice, rows: np.ndarray) -> None:
    """Fill rows of the file with a block of the Gaussians: `_columns` in order, with the normals after the means.

    Arrays of three or four columns are copied column by column: NumPy is slow with innermost loops so short.
    """
    sh = gaussians.sh[block]
    coefficients = sh.shape[1]
    index = np.arange(3 * coefficients).reshape(coefficients, 3)  # of coefficient and channel, in the rows of sh
    order = np.concatenate([index[0], index[1:].T.ravel()])
    rows[:, 6:-8] = sh.reshape(len(sh), -1).take(order, axis=1)
    opacities = np.clip(gaussians.opacities[block], MIN_OPACITY, 1 - MIN_OPACITY)
    log_scales = np.log(np.maximum(gaussians.scales[block], MIN_SCALE))
    for axis in range(3):
        rows[:, axis] = gaussians.means[block, axis]
        rows[:, axis - 7] = log_scales[:, axis]
    rows[:, -8] = np.log(opacities / (1 - opacities))
    for part in range(4):
        rows[:, part - 4] = gaussians.quats[block, part]


class _Vertices(NamedTuple):
    """Position and layout of the vertices in a file."""

    offset: int
    length: int
    row: np.dtype
    sh_coefficients: int


def _read_vertices(file: BinaryIO, path: Path, vertices: _Vertices) -> Gaussians:
    """Decode the rows of a checked file."""
    count = vertices.length
    gaussians = Gaussians(
        means=np.empty((count, 3), np.float32),
        scales=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, vertices.sh_coefficients, 3), np.float32),
    )
    file.seek(vertices.offset)
    # Overflow to infinity or NaN is checked for below; an opacity that underflows to 0 is right.
    with np.errstate(over="ignore", invalid="ignore"):
        for block in _blocks(count):
            rows = np.frombuffer(file.read((block.stop - block.start) * vertices.row.itemsize), vertices.row)
            _decode(rows, gaussians, block)
            _check_finite(gaussians, block, path)
    return gaussians


def _decode(rows: np.ndarray, gaussians: Gaussians, block: slice) -> None:
    """Fill a block of the Gaussians from structured rows of a file, in whatever order its columns are."""
    table, column = _float_table(rows, list(_columns(gaussians)))
    sh, scales, opacities = gaussians.sh[block], gaussians.scales[block], gaussians.opacities[block]
    coefficients = sh.shape[1]
    for axis, name in enumerate("xyz"):
        gaussians.means[block, axis] = table[:, column[name]]
        scales[:, axis] = table[:, column[f"scale_{axis}"]]
    np.exp(scales, out=scales)
    opacities[:] = 1 / (1 + np.exp(-table[:, column["opacity"]]))
    for part in range(4):
        gaussians.quats[block, part] = table[:, column[f"rot_{part}"]]
    names = [f"f_dc_{channel}" for channel in range(3)]
    names += [f"f_rest_{channel * (coefficients - 1) + k}" for k in range(coefficients - 1) for channel in range(3)]
    # mode="clip" lets take() write to `out` without a buffer.
    np.take(table, [column[name] for name in names], axis=1, out=sh.reshape(len(rows), len(names)), mode="clip")


def _float_table(rows: np.ndarray, names: list[str]) -> tuple[np.ndarray, dict[str, int]]:
    """Rows as float32 [rows, columns], and the column of each name; a view where all columns are float32."""
    own = rows.dtype.names or ()
    if all(rows.dtype[name] == np.float32 for name in own):
        return rows.view(np.float32).reshape(len(rows), len(own)), {name: index for index, name in enumerate(own)}
    table = np.stack([rows[name].astype(np.float32) for name in names], axis=1)
    return table, {name: index for index, name in enumerate(names)}


def _check_finite(gaussians: Gaussians, block: slice, path: Path) -> None:
    """Raise InputError for the first value of a block of decoded Gaussians that is not finite."""
    arrays = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.sh)
    if all(np.isfinite(array[block].sum()) for array in arrays):  # quicker: the sum is finite only if every value is
        return
    for name, column in _columns(gaussians).items():
        for vertex in np.flatnonzero(~np.isfinite(column[block])):
            raise InputError(
                f"{path}: {name} of vertex {block.start + vertex} is not a finite number; remove that vertex"
            )


def _find_vertices(file: BinaryIO, path: Path) -> _Vertices:
    """Check the header and the size of a splat file."""
    offset = 0
    elements, header_bytes = read_header(file, path)
    for element in elements:
        if element.name == "vertex":
            break
        if LIST in element.properties.values():
            raise_input_error(
                path, f"element {element.name} with lists stands before the vertices", "write the vertices first"
            )
        offset += element.length * element.row.itemsize
    else:
        raise_input_error(path, "the header has no element vertex", "give a 3D Gaussian splatting .ply")

    sh_coefficients = _checked_properties(element, path)
    row = element.row
    offset += header_bytes
    expected, size = offset + element.length * row.itemsize, os.fstat(file.fileno()).st_size
    if size < expected:
        raise_input_error(
            path,
            f"cut short: {element.length} vertices need {expected} bytes, the file has {size}",
            "copy or download it again",
        )
    return _Vertices(offset, element.length, row, sh_coefficients)


def _checked_properties(vertex: Element, path: Path) -> int:
    """SH coefficients per channel of an element, once it has all properties of a Gaussian as floating-point numbers."""
    rest = sum(name.startswith("f_rest_") for name in vertex.properties)
    coefficients = 1 + rest // 3
    if rest not in (0, 9, 24, 45):
        raise_input_error(
            path,
            f"{rest} properties f_rest_*",
            "expected 0, 9, 24 or 45 (SH degree 0 to 3); write it with one of those",
        )
    sample = np.empty((0, coefficients, 3))
    needed = _columns(Gaussians(sample[:, 0], sample[:, 0], np.empty((0, 4)), np.empty(0), sample))
    missing = [name for name in needed if name not in vertex.properties]
    if missing:
        raise_input_error(
            path,
            f"element vertex has no property {', '.join(missing)}",
            "give a 3D Gaussian splatting .ply, not a mesh, plain points or a compressed splat",
        )
    for name in needed:
        if vertex.properties[name] not in ("<f4", "<f8"):
            raise_input_error(path, f"property {name} is not float or double", "write it as float")
    if LIST in vertex.properties.values():
        raise_input_error(path, "element vertex has a list property", "write the file without it")
    return coefficients
