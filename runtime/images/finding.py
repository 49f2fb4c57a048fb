"""Image and video files by their names: which formats are supported, and finding images, in natural order.

No image is decoded here, and OpenCV is not loaded.
"""

import glob
import os
from collections.abc import Sequence
from pathlib import Path, PurePath

from natsort import natsort_keygen, ns

from ..errors import InputError
from ..system.files import check_regular

# Supported formats.
SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".tif", ".tiff", ".bmp", ".jp2", ".avif", ".ppm", ".pgm"),
    *(".heic", ".heif", ".hif"),
)
# Image formats that are not supported, whose files are reported when a folder holds them.
UNSUPPORTED_SUFFIXES = (
    *(".gif", ".jxl", ".jxr", ".jpf", ".j2k", ".exr", ".hdr", ".psd", ".tga", ".svg", ".pbm", ".pnm", ".insp"),
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw"),
    *(".3fr", ".iiq", ".x3f"),
)
# Supported formats of videos.
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
EXAMPLES = 3  # names listed in a message


def find_images(given: Sequence[str | Path]) -> list[Path]:
    """The images in folders, globs and files, without duplicates, in natural order (img2 before img10).

    Raises InputError if an input does not exist or is not an image, or if nothing is found.
    """
    found = [path for item in given for path in _images_of(item)]
    if not found:
        raise InputError(f"no images given; expected a folder, a glob or files ending in {', '.join(SUFFIXES)}")
    return sorted({os.path.abspath(path): path for path in reversed(found)}.values(), key=_natural)


def first_match(item: Path) -> Path:
    """The first file of a glob, in natural order; what exists, or matches nothing, as it is."""
    return item if item.exists() else min(map(Path, glob.glob(str(item))), key=_natural, default=item)


def image_stem(path: PurePath) -> str:
    """The file name without the suffix of an image format; other suffixes, as in `r_0.5`, are kept."""
    return path.stem if path.suffix.lower() in SUFFIXES else path.name


def is_video(path: Path) -> bool:
    """Whether a file is a video by its suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def unsupported_images(given: Sequence[str | Path]) -> list[Path]:
    """Images of unsupported formats, by suffix, in folders and globs, in natural order."""
    found = [path for item in given for path in _files_of(item) if _is_unread(path)]
    return sorted(set(found), key=_natural)


def describe_unsupported(given: Sequence[str | Path]) -> list[str]:
    """A note that names the `unsupported_images`, or none."""
    left = unsupported_images(given)
    if not left:
        return []
    names = ", ".join(path.name for path in left[:EXAMPLES]) + (", ..." if len(left) > EXAMPLES else "")
    count = "1 image is" if len(left) == 1 else f"{len(left)} images are"
    return [f"{count} of an unsupported format, and left out: {names}; save as JPEG or PNG"]


def _images_of(item: str | Path) -> list[Path]:
    """The images of one input."""
    path = Path(item)
    expected = f"expected {', '.join(SUFFIXES)}"
    files = _files_of(item)
    if path.exists() and not path.is_dir():
        check_regular(path)
    if path.is_file() and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: not an image by its suffix; {expected}, or one video ({', '.join(VIDEO_SUFFIXES)})")
    if not files and not path.is_dir():
        raise InputError(f"{item}: no such file or folder, nor a pattern that matches one; expected images")
    images = [file for file in files if _is_image(file)]
    if not images:
        where = "no images in this folder" if path.is_dir() else "matches no images"
        others = f", but {sum(map(_is_unread, files))} of formats that are not read" * any(map(_is_unread, files))
        raise InputError(f"{item}: {where}{others}; {expected}")
    return images


def _files_of(item: str | Path) -> list[Path]:
    """The paths of one input; an existing path is never taken for a glob."""
    path = Path(item)
    if path.is_dir():
        return list(path.iterdir())
    return [path] if path.is_file() else [Path(name) for name in glob.glob(str(item), recursive=True)]


def _is_image(path: Path) -> bool:
    # macOS leaves ._name.jpg beside name.jpg
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _is_unread(path: Path) -> bool:
    return path.suffix.lower() in UNSUPPORTED_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _natural(path: Path) -> tuple[object, str]:
    """The key of natural sorting, without regard to case; equal ones are sorted by the path."""
    return _natural_key(path.as_posix()), path.as_posix()


_natural_key = natsort_keygen(alg=ns.IGNORECASE)
