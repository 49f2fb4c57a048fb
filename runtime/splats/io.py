"""Reading and writing Gaussians in every file format, chosen by the ending of the file's name.

A new format is one module in `formats/` and one entry in FORMATS.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..system.output_names import MESH_ENDINGS, POINT_ENDINGS
from .formats.compressed_ply import read_compressed_ply, write_compressed_ply
from .formats.encoding import lost_offset as lost_offset
from .formats.glb import glb_offset, read_glb, write_glb
from .formats.ply import read_ply, write_ply
from .formats.ply_header import has_element, header_offset
from .formats.sog import read_sog, sog_offset, write_sog
from .formats.splat import read_splat, write_splat
from .formats.spz import read_spz, write_spz
from .gaussians import Gaussians, check_finite
from .points import points_from_gaussians, write_point_cloud


class SplatFormat(NamedTuple):
    """The functions of one format.

    write: path, Gaussians and the offset that was subtracted from the world coordinates, [3]; returns a line for each
    thing that the file does not hold. read: path. read_offset: path; None where the format cannot record an offset.
    All raise InputError.
    """

    write: Callable[[Path, Gaussians, np.ndarray], list[str]]
    read: Callable[[Path], Gaussians]
    read_offset: Callable[[Path], np.ndarray] | None = None


def _read_any_ply(path: Path) -> Gaussians:
    """Either layout: a compressed .ply need not be named .compressed.ply."""
    return read_compressed_ply(path) if has_element(path, "chunk") else read_ply(path)


FORMATS = {
    ".ply": SplatFormat(write_ply, _read_any_ply, header_offset),
    ".compressed.ply": SplatFormat(write_compressed_ply, _read_any_ply, header_offset),
    ".splat": SplatFormat(write_splat, read_splat),
    ".spz": SplatFormat(write_spz, read_spz),
    ".sog": SplatFormat(write_sog, read_sog, sog_offset),
    ".glb": SplatFormat(write_glb, read_glb, glb_offset),
}


def write_splats(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians in the format given by the file's name; the file is replaced atomically.

    offset: what was subtracted from the world coordinates, [3], for the file to record; None for zero.
    As a point cloud, the means are written with the colours of SH degree 0.

    Returns a line for each thing that the format cannot hold, such as SH coefficients above degree 0.
    Raises InputError for an unknown ending, values that no file can hold, or a path that cannot be written.
    """
    suffix, offset = splat_suffix(path), np.zeros(3) if offset is None else offset
    if suffix in MESH_ENDINGS:
        raise InputError(f"{path}: a mesh is made of depth maps, not of Gaussians; write it with idesplat infer")
    if suffix in POINT_ENDINGS:
        check_finite(path, gaussians)
        write_point_cloud(Path(path), points_from_gaussians(gaussians))
        return ["points only: no scales, rotations, opacities or view-dependent colour", *lost_offset(offset)]
    return FORMATS[suffix].write(Path(path), gaussians, offset)


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians from a file in any of the formats; raises InputError if that is not possible."""
    suffix, expected = _ending(path, (*FORMATS, *POINT_ENDINGS, *MESH_ENDINGS)), ", ".join(FORMATS)
    if suffix is None:
        raise InputError(f"{path}: expected a splat file, whose name ends in {expected}")
    if suffix not in FORMATS:
        raise InputError(f"{path}: points and meshes hold no Gaussians; give a file that ends in {expected}")
    return FORMATS[suffix].read(Path(path))


def read_offset(path: Path) -> np.ndarray:
    """The offset that a splat file records as subtracted from its world coordinates, float64 [3]; zeros if none.

    Raises InputError if the file cannot be read.
    """
    read = FORMATS[splat_suffix(path)].read_offset
    return np.zeros(3) if read is None else read(Path(path))


def splat_suffix(path: Path) -> str:
    """The longest ending of a file's name that stands for a format; raises InputError if there is none."""
    known = (*FORMATS, *POINT_ENDINGS, *MESH_ENDINGS)
    suffix = _ending(path, known)
    if suffix is None:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(known)}")
    return suffix


def _ending(path: Path, known: Sequence[str]) -> str | None:
    """The longest of these endings that a file's name has, in whatever case."""
    name = Path(path).name.lower()
    return max((suffix for suffix in known if name.endswith(suffix)), key=len, default=None)


def holds_splats(path: Path) -> bool:
    """Whether the file's name stands for splats, not points or a mesh; raises InputError as `splat_suffix`."""
    return splat_suffix(path) in FORMATS


def is_mesh(path: Path) -> bool:
    """Whether the file's name stands for a mesh; raises InputError as `splat_suffix`."""
    return splat_suffix(path) in MESH_ENDINGS
