"""The files that a command's inputs consist of, which `outputs` protects from being replaced."""

import glob
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..cameras.camera import Camera

# Another folder where datasets keep images; commands read it only if it is given.
UNDISTORTED_FROM = "input"


def model_files(model: Path) -> list[Path]:
    """A model with the files of its weights, or all files of a staged folder; none where there is none."""
    if os.path.isdir(model):
        return [path for path in _children(model) if os.path.isfile(path)]
    return [model, *(Path(name) for name in glob.glob(f"{glob.escape(str(model))}*data"))]


def camera_files(cameras: Path) -> list[Path]:
    """The files that are read if this file or folder is given as cameras."""
    from ..cameras.io import input_files

    return [path for path in input_files(cameras) if os.path.isfile(path)]


def given_images(given: Sequence[str | Path]) -> list[Path]:
    """The images and videos that folders, globs and files name; missing ones are skipped."""
    from ..images.finding import SUFFIXES

    found: list[Path] = []
    for item in given:
        path = Path(item)
        if os.path.isdir(path):
            found += [child for child in _children(path) if child.suffix.lower() in SUFFIXES]
        elif os.path.exists(path):
            found.append(path)
        else:
            found += [Path(name) for name in glob.glob(str(item), recursive=True)]
    return found


def with_cameras(images: list[Path], cameras: Sequence["Camera"]) -> list[Path]:
    """The images that a camera names; how many are left out is noted, such as those that could not be registered."""
    from ..views.batch import images_with_cameras
    from .reporting import note

    found = images_with_cameras(images, cameras)
    if len(found) < len(images):
        note(f"note: {len(images) - len(found)} of {len(images)} images have no camera; left out")
    return found


def named_images(path: Path, cameras: Iterable["Camera"]) -> list[Path]:
    """The images that cameras name, as paths beside their file; they need not exist.

    path: the file or folder that the cameras were read from.
    """
    folder = path if os.path.isdir(path) else path.parent
    return [folder / _posix(camera.name) for camera in cameras]


def nearby_images(path: Path, cameras: Iterable["Camera"]) -> list[Path]:
    """The likely images of the cameras: files with their names in the folders where datasets keep images.

    path: the file or folder that the cameras were read from, such as `sparse/0` beside a folder `images`.
    """
    from ..cameras.image_files import IMAGE_FOLDERS, image_roots
    from ..images.finding import SUFFIXES, image_stem

    stems_in = defaultdict(set)  # folder of a name -> its stems
    for camera in cameras:
        name = _posix(camera.name)
        stems_in[name.parent].add(image_stem(name))
    roots, names = image_roots(path), ("", *IMAGE_FOLDERS, UNDISTORTED_FROM)
    found = []
    for below, stems in stems_in.items():
        for place in dict.fromkeys(root / name / below for root in roots for name in names):
            children = (child for child in _children(place) if child.suffix.lower() in SUFFIXES)
            found += [child for child in children if image_stem(child) in stems]
    return found


def _children(folder: Path) -> list[Path]:
    """The entries of a folder; empty if it is not a readable folder."""
    try:
        return list(folder.iterdir())
    except (OSError, ValueError):
        return []


def _posix(name: str) -> PurePosixPath:
    return PurePosixPath(name.replace("\\", "/"))  # files written on Windows
