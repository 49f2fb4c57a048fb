"""Every file that a scene is written to or read from, chosen by the ending of its name.

To add a format, write one file with a writer and a reader, and one line here.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from .formats.compressed_ply import read_compressed_ply, write_compressed_ply
from .formats.glb import glb_offset, read_glb, write_glb
from .formats.ply import read_ply, write_ply
from .formats.ply_header import has_element, header_offset
from .formats.sog import read_sog, sog_offset, write_sog
from .formats.splat import read_splat, write_splat
from .formats.spz import read_spz, write_spz
from .gaussians import Gaussians, check_finite
from .points import points_from_gaussians, write_point_cloud


class SplatFormat(NamedTuple):
    """How Gaussians become one kind of file and come back.

    write: is given what was subtracted from the world coordinates, [3]; returns a line for each thing that the file
    does not hold. offset: reads that back; None where the format has no room for it.
    """

    write: Callable[[Path, Gaussians, np.ndarray], list[str]]
    read: Callable[[Path], Gaussians]
    offset: Callable[[Path], np.ndarray] | None = None


def _write_ply(path: Path, gaussians: Gaussians, offset: np.ndarray) -> list[str]:
    write_ply(path, gaussians, offset)
    return []


def _write_splat(path: Path, gaussians: Gaussians, offset: np.ndarray) -> list[str]:
    return write_splat(path, gaussians) + lost_offset(offset)


def _write_spz(path: Path, gaussians: Gaussians, offset: np.ndarray) -> list[str]:
    return write_spz(path, gaussians) + lost_offset(offset)


def lost_offset(offset: np.ndarray) -> list[str]:
    """A line about an offset that a format has no room for."""
    if not offset.any():
        return []
    return [f"the file does not hold that its coordinates are relative to {', '.join(map(repr, offset.tolist()))}"]


def _read_ply(path: Path) -> Gaussians:
    """Either layout: a compressed .ply need not be named so."""
    return read_compressed_ply(path) if has_element(path, "chunk") else read_ply(path)


FORMATS = {
    ".ply": SplatFormat(_write_ply, _read_ply, header_offset),
    ".compressed.ply": SplatFormat(write_compressed_ply, _read_ply, header_offset),
    ".splat": SplatFormat(_write_splat, read_splat),
    ".spz": SplatFormat(_write_spz, read_spz),
    ".sog": SplatFormat(write_sog, read_sog, sog_offset),
    ".glb": SplatFormat(write_glb, read_glb, glb_offset),
}


# Endings that stand for points and surfaces, where the last one alone may stand for splats.
POINTS = (".points.ply", ".points.glb", ".obj", ".xyz")
MESHES = (".mesh.ply", ".mesh.glb", ".mesh.obj")


def write_splats(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians in the format that the file's name asks for; the file appears whole or not at all.

    As points, they are their centres in the colour that they have from all sides.
    offset: what was subtracted from the world coordinates, [3], which the file is to record; None for nothing.

    Returns a line for each thing that the format cannot hold, such as spherical harmonics.
    Raises InputError for an unknown name, values that no file can hold, or a place that cannot be written.
    """
    suffix, offset = splat_suffix(path), np.zeros(3) if offset is None else offset
    if suffix in MESHES:
        raise InputError(f"{path}: a surface is made of depth maps, not of Gaussians; write it with idesplat-infer")
    if suffix in POINTS:
        check_finite(path, gaussians)
        write_point_cloud(Path(path), points_from_gaussians(gaussians))
        return ["points alone, without size, opacity or anything that changes with the direction", *lost_offset(offset)]
    return FORMATS[suffix].write(Path(path), gaussians, offset)


def read_offset(path: Path) -> np.ndarray:
    """What was subtracted from the world coordinates of a splat file's Gaussians, float64 [3].

    Zeros where the file says nothing. Raises InputError if it cannot be read.
    """
    read = FORMATS[splat_suffix(path)].offset
    return np.zeros(3) if read is None else read(Path(path))


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians from a file in any of the formats; raises InputError if that is not possible."""
    suffix, expected = _ending(path, (*FORMATS, *POINTS, *MESHES)), ", ".join(FORMATS)
    if suffix is None:
        raise InputError(f"{path}: expected a splat file, whose name ends in {expected}")
    if suffix not in FORMATS:
        raise InputError(f"{path}: points and surfaces hold no Gaussians; give a file that ends in {expected}")
    return FORMATS[suffix].read(Path(path))


def splat_suffix(path: Path) -> str:
    """The longest ending of a file's name that stands for a format; raises InputError if there is none."""
    known = (*FORMATS, *POINTS, *MESHES)
    suffix = _ending(path, known)
    if suffix is None:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(known)}")
    return suffix


def _ending(path: Path, known: Sequence[str]) -> str | None:
    """The longest of these endings that a file's name has, in whatever case."""
    name = Path(path).name.lower()
    return max((suffix for suffix in known if name.endswith(suffix)), key=len, default=None)


def holds_splats(path: Path) -> bool:
    """Whether the file's name asks for splats, not points or a surface; raises InputError as `splat_suffix`."""
    return splat_suffix(path) in FORMATS


def is_surface(path: Path) -> bool:
    """Whether the file's name asks for a surface; raises InputError as `splat_suffix`."""
    return splat_suffix(path) in MESHES
