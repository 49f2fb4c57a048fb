"""Camera file formats: one module each, registered in `CameraFormat`.

To add a format, write a module in this package and add a line to `CameraFormat`. The module has

    DESCRIPTION: str                                      what such a file is called in messages
    detect(source: CameraSource) -> bool                  whether a file or folder has this format
    read(path: Path, images: Sequence[Path]) -> list[Camera]      its cameras, in the conventions of `Camera`

and, where the defaults do not fit,

    read_image_names(path: Path) -> list[str]             the images that it names, where `read` needs these images
    input_files(path: Path) -> list[Path]                 the files that `read` reads for this path (default: the path)

`Camera` checks what every format can get wrong. All readers raise InputError.
"""

from collections.abc import Iterator
from enum import StrEnum
from importlib import import_module
from types import ModuleType

# Of the files of all formats: JSON, text, COLMAP's binaries, NumPy arrays, OpenCV's calibrations.
CAMERA_SUFFIXES = (".json", ".txt", ".bin", ".npy", ".yml", ".yaml", ".xml")
ESTIMATE = "estimate"  # given in place of a camera file: estimate the cameras from the images


class CameraFormat(StrEnum):
    """The formats, in the order in which they are tried on a file; a value is the name of the format's module."""

    OWN = "own"
    TRANSFORMS = "transforms"
    COLMAP = "colmap"
    LLFF = "llff"
    DTU = "dtu"
    OPENCV = "opencv"
    RE10K = "re10k"


def format_module(camera_format: CameraFormat) -> ModuleType:
    """The module that reads a format."""
    return import_module(f".{camera_format}", __name__)


def format_modules() -> Iterator[tuple[CameraFormat, ModuleType]]:
    """All formats with their modules, in order."""
    return ((camera_format, format_module(camera_format)) for camera_format in CameraFormat)
