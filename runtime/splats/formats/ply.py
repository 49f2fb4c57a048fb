"""Gaussians in the .ply layout of 3D Gaussian splatting, which every viewer reads.

One element `vertex`, binary little endian, float32: x y z, normals that mean nothing, SH band 0 as f_dc_*, the other
bands as f_rest_* (all of red, then green, then blue), the opacity as its logit, the scales as their logarithms, the
rotation as a wxyz quaternion. The frame is the scene's own, axes as OpenCV has them.
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

VERTICES_AT_ONCE = 1 << 13  # their rows stay in the cache while columns are filled one by one
MIN_OPACITY = 1e-6  # a logit must be finite: opacities are kept this far from 0 and 1
MIN_SCALE = 1e-30  # so must a logarithm


def write_ply(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians, every SH band, as a binary .ply; the file appears whole or not at all.

    offset: what was subtracted from the world coordinates, [3], which a comment records.
    Opacities are kept 1e-6 away from 0 and 1, so that their logit is finite. Raises InputError if a value is not
    finite, a scale is negative, an opacity outside [0, 1], or the file cannot be written.
    """
    check_ranges(path, gaussians)
    names = list(_columns(gaussians))
    names[3:3] = ["nx", "ny", "nz"]  # gaussforge and some older viewers insist on normals
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
    """Read a 3DGS .ply: properties in any order, float or double, with or without normals, others left alone.

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
    """A view of each column, [gaussians], under its name in the file and in the file's usual order."""
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
    """0 to count in steps that fit the cache."""
    for start in range(0, count, VERTICES_AT_ONCE):
        yield slice(start, min(start + VERTICES_AT_ONCE, count))


def _reserve(file: BinaryIO, size: int) -> None:
    """Claim the disk space at once where the system can: writing is three times faster than letting the file grow."""
    if hasattr(os, "posix_fallocate"):
        with suppress(OSError):  # not every file system can; a full disk shows again when it is written to
            os.posix_fallocate(file.fileno(), 0, size)


def _encode(gaussians: Gaussians, block: slice, rows: np.ndarray) -> None:
    """Fill rows of the file with a block of the Gaussians: `_columns` in order, the normals after the means left alone.

    What has three or four parts goes column by column, since NumPy is slow where its innermost loop is so short.
    """
    sh = gaussians.sh[block]
    coefficients = sh.shape[1]
    places = np.arange(3 * coefficients).reshape(coefficients, 3)  # of coefficient and channel, in the rows of sh
    order = np.concatenate([places[0], places[1:].T.ravel()])
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
    """Where the vertices lie in a file and what a row of them holds."""

    offset: int
    length: int
    row: np.dtype
    sh_coefficients: int


def _read_vertices(file: BinaryIO, path: Path, vertices: _Vertices) -> Gaussians:
    """The rows of a checked file, decoded."""
    count = vertices.length
    gaussians = Gaussians(
        means=np.empty((count, 3), np.float32),
        scales=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, vertices.sh_coefficients, 3), np.float32),
    )
    file.seek(vertices.offset)
    # To infinity or NaN, which are refused below, or to an opacity of 0, which is meant.
    with np.errstate(over="ignore", invalid="ignore"):
        for block in _blocks(count):
            rows = np.frombuffer(file.read((block.stop - block.start) * vertices.row.itemsize), vertices.row)
            _decode(rows, gaussians, block)
            _check_finite(gaussians, block, path)
    return gaussians


def _decode(rows: np.ndarray, gaussians: Gaussians, block: slice) -> None:
    """Fill a block of the Gaussians from structured rows of a file, whatever the order of its columns."""
    table, place = _float_table(rows, list(_columns(gaussians)))
    sh, scales, opacities = gaussians.sh[block], gaussians.scales[block], gaussians.opacities[block]
    coefficients = sh.shape[1]
    for axis, name in enumerate("xyz"):
        gaussians.means[block, axis] = table[:, place[name]]
        scales[:, axis] = table[:, place[f"scale_{axis}"]]
    np.exp(scales, out=scales)
    opacities[:] = 1 / (1 + np.exp(-table[:, place["opacity"]]))
    for part in range(4):
        gaussians.quats[block, part] = table[:, place[f"rot_{part}"]]
    names = [f"f_dc_{channel}" for channel in range(3)]
    names += [f"f_rest_{channel * (coefficients - 1) + k}" for k in range(coefficients - 1) for channel in range(3)]
    # All at once and already in their places ("clip" lets it write there directly).
    np.take(table, [place[name] for name in names], axis=1, out=sh.reshape(len(rows), len(names)), mode="clip")


def _float_table(rows: np.ndarray, names: list[str]) -> tuple[np.ndarray, dict[str, int]]:
    """Rows as float32 [rows, columns], with the columns of these names in the places given; usually a mere view."""
    own = rows.dtype.names or ()
    if all(rows.dtype[name] == np.float32 for name in own):
        return rows.view(np.float32).reshape(len(rows), len(own)), {name: index for index, name in enumerate(own)}
    table = np.stack([rows[name].astype(np.float32) for name in names], axis=1)
    return table, {name: index for index, name in enumerate(names)}


def _check_finite(gaussians: Gaussians, block: slice, path: Path) -> None:
    """Raise InputError for the first value of a block of decoded Gaussians that is not finite."""
    arrays = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.sh)
    if all(np.isfinite(array[block].sum()) for array in arrays):  # no sum of others is finite, and it is quicker
        return
    for name, column in _columns(gaussians).items():
        for vertex in np.flatnonzero(~np.isfinite(column[block])):
            raise InputError(
                f"{path}: {name} of vertex {block.start + vertex} is not a finite number; remove that vertex"
            )


def _find_vertices(file: BinaryIO, path: Path) -> _Vertices:
    """Check header and size of a file against what a splat file must have."""
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
    """SH coefficients a channel of an element that has all that a Gaussian needs, as floating-point numbers."""
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
