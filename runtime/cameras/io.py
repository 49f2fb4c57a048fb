"""Reading and writing cameras. Every format is converted on load to the one convention of `Camera`.

A pose is camera-to-world with OpenCV axes (x right, y down, z forward); K is in pixels, with the centre of the top left
pixel at (0.5, 0.5). The package `formats` says how to add a format.
"""

import logging
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ..errors import InputError, error_context
from .camera import Camera
from .formats import CameraFormat as CameraFormat
from .formats import format_module, format_modules, own, transforms
from .source import CameraSource

LOG = logging.getLogger(__name__)


def read_cameras(path: Path, images: Sequence[Path] = (), camera_format: CameraFormat | None = None) -> list[Camera]:
    """Read the cameras of a file or folder.

    images: the images of these cameras. Formats that do not store image names or sizes take them from here, or from
    images beside the file; the module of each format says which it needs.
    camera_format: the format; detected from the content by default.
    Raises InputError that names the file, the entry and the field.
    """
    path = Path(path)
    with error_context(str(path)):
        camera_format = camera_format or detect_format(path)
        cameras: list[Camera] = format_module(camera_format).read(path, images)
        _check_names(cameras)
    LOG.info("%s: %d cameras, format %s", path, len(cameras), camera_format)
    return cameras


def read_image_names(path: Path, camera_format: CameraFormat | None = None) -> list[str]:
    """The image names that a file or folder of cameras stores, in order. Raises InputError as `read_cameras`."""
    with error_context(str(path)):
        module = format_module(camera_format or detect_format(path))
        if hasattr(module, "read_image_names"):
            names: list[str] = module.read_image_names(path)
            return names
    return [camera.name for camera in read_cameras(path, (), camera_format)]


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write a file in this project's own format, or a transforms.json if the file has this name.

    `read_cameras` reads the own format back exactly. Raises InputError if the folder is not writable, or if the format
    cannot represent a camera.
    """
    path = Path(path)
    writer = transforms if path.name == transforms.FILE_NAME else own
    writer.write(path, cameras)


def check_writable(path: Path, cameras: Sequence[Camera]) -> None:
    """Raise InputError if `write_cameras` could not represent a camera in the format of this file."""
    if path.name == transforms.FILE_NAME:
        transforms.check_writable(cameras)


def detect_format(path: Path) -> CameraFormat:
    """The format of a file or folder of cameras, from its content. Raises InputError if none fits."""
    source = CameraSource(Path(path))
    for camera_format, module in format_modules():
        if module.detect(source):
            return camera_format
    known = ", ".join(module.DESCRIPTION for _, module in format_modules())
    holds = "is a folder without cameras" if source.is_folder else "holds no cameras"
    raise InputError(f"{holds} of a known format: {known}; give another file, or --camera-format if it is one of these")


def input_files(path: Path) -> list[Path]:
    """The files that `read_cameras` may read for this path, whatever its format; they need not exist."""
    found = [path]
    for _, module in format_modules():
        if hasattr(module, "input_files"):
            found += module.input_files(path)
    return list(dict.fromkeys(found))


def _check_names(cameras: Sequence[Camera]) -> None:
    seen: set[PurePosixPath] = set()
    for index, camera in enumerate(cameras):
        if PurePosixPath(camera.name) in seen:
            raise InputError(
                f"camera {index} names the image {camera.name} a second time, expected one camera for each image"
            )
        seen.add(PurePosixPath(camera.name))
