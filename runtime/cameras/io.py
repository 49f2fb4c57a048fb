"""Cameras: one convention inside, and every convention outside converted at the door, a file for each format.

Inside, a pose is camera-to-world with OpenCV axes (x right, y down, z forward) and K is in pixels with the centre of
the top left pixel at (.5, .5). To read another format, write one module with a function `read` that returns `Camera`s,
and name it in `CameraFormat` and `detect_format`; `Camera` itself checks what every format can get wrong.
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path, PurePosixPath

from ..errors import InputError, error_context
from ..system.files import open_regular
from .camera import Camera
from .format_names import COLMAP_PARTS, CameraFormat

START = 4096  # bytes of a file that tell its format
RE10K_COLUMNS = 19


def read_cameras(path: Path, images: Sequence[Path] = (), camera_format: CameraFormat | None = None) -> list[Camera]:
    """Read a file, or a folder, of cameras.

    images: the photographs that the cameras belong to. Some formats do not name them, or do not give their size, and
    then need them here or beside the file; the module of each format says which.
    camera_format: the format, where the content is not to tell it.
    Raises InputError naming the file, the entry and the field.
    """
    path = Path(path)
    with error_context(str(path)):
        reader = import_module(f".formats.{camera_format or detect_format(path)}", __package__)
        cameras: list[Camera] = reader.read(path, images)
        _check_names(cameras)
    return cameras


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write this project's own file, which `read_cameras` reads back unchanged; or a transforms.json, if named so.

    Raises InputError if the folder cannot be written, or the format cannot say what a camera is.
    """
    from .formats import own as cameras_own
    from .formats import transforms as cameras_transforms

    path = Path(path)
    writer = cameras_transforms if path.name == cameras_transforms.FILE_NAME else cameras_own
    writer.write(path, cameras)


def detect_format(path: Path) -> CameraFormat:
    """The format of a file or folder of cameras, by what it holds; raises InputError if it is none of them."""
    if path.is_dir():
        return _recognise_folder(path)
    if path.name in {name + suffix for name in COLMAP_PARTS for suffix in (".bin", ".txt")}:
        return CameraFormat.COLMAP
    try:
        with open_regular(path) as file:
            start = file.read(START).removeprefix(b"\xef\xbb\xbf").lstrip()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror}); expected a file of cameras") from None
    if path.suffix.lower() == ".json" or start.startswith((b"{", b"[")):
        return _recognise_json(path)
    if start.startswith(b"\x93NUMPY"):
        return CameraFormat.LLFF
    if start.startswith((b"%YAML", b"<?xml", b"<opencv_storage")):
        return CameraFormat.OPENCV
    if start.startswith(b"extrinsic"):
        return CameraFormat.DTU
    if any(len(line.split()) == RE10K_COLUMNS for line in start.splitlines()[:2]):
        return CameraFormat.RE10K
    raise InputError(
        "is none of the camera files that are known by their content: transforms.json, a COLMAP model, a RealEstate10K "
        "trajectory, poses_bounds.npy, a cam.txt, OpenCV's stereo calibration, or this project's JSON; "
        "if it is one of them, give --camera-format"
    )


def _check_names(cameras: Sequence[Camera]) -> None:
    seen: set[PurePosixPath] = set()
    for index, camera in enumerate(cameras):
        if PurePosixPath(camera.name) in seen:
            raise InputError(
                f"camera {index} names the image {camera.name} a second time, expected one camera for each"
            )
        seen.add(PurePosixPath(camera.name))


# ---- which format


def _recognise_folder(folder: Path) -> CameraFormat:
    from .formats import colmap as cameras_colmap
    from .formats import dtu as cameras_dtu
    from .formats import llff as cameras_llff
    from .formats import transforms as cameras_transforms

    if (folder / cameras_transforms.FILE_NAME).is_file():
        return CameraFormat.TRANSFORMS
    if cameras_colmap.models_in(folder):
        return CameraFormat.COLMAP
    if (folder / cameras_llff.FILE_NAME).is_file():
        return CameraFormat.LLFF
    if cameras_dtu.files_in(folder):
        return CameraFormat.DTU
    raise InputError(
        "is a folder without transforms.json, COLMAP model, poses_bounds.npy or *_cam.txt; give the file of cameras"
    )


def _recognise_json(path: Path) -> CameraFormat:
    from .formats import own as cameras_own
    from .parsing import read_json

    document = read_json(path)
    if document.get("format") == cameras_own.FORMAT:
        return CameraFormat.OWN
    if "frames" in document:
        return CameraFormat.TRANSFORMS
    raise InputError(f'no cameras here: expected a transforms.json with "frames", or "format": "{cameras_own.FORMAT}"')
