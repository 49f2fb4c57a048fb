"""The pictures that a camera file leaves unnamed or unmeasured: among those that were given, or beside the file."""

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ..images.header import image_size
from ..images.io import SUFFIXES, find_images, stem

GIVE_PICTURES = "give the pictures with --images, which idesplat-cameras convert takes, too"


# Where datasets keep the images that a camera file names: in its own folder, and in these of it and of those above,
# since COLMAP's models lie in `sparse/0`.
IMAGE_FOLDERS = ("images", "image", "blended_images")
FOLDERS_ABOVE = 3


def image_roots(cameras: Path) -> list[Path]:
    """The folder of a camera file, or the folder of cameras itself, and those above it that may hold its images."""
    folder = cameras if os.path.isdir(cameras) else cameras.parent
    return [folder, *folder.resolve().parents[:FOLDERS_ABOVE]]


class PictureSizes:
    """Sizes of the pictures that cameras name.

    A picture is the one among `pictures` with that name, whatever the suffix, or else a file relative to `folder`.
    """

    def __init__(self, folder: Path, pictures: Sequence[Path]) -> None:
        self.folder = folder
        self._given = {stem(picture): picture for picture in reversed(pictures)}

    def size(self, name: str) -> tuple[int, int] | None:
        """Width and height of the picture that a camera names, or None where there is no such picture.

        Raises InputError if the picture cannot be read.
        """
        given = self._given.get(stem(PurePosixPath(name.replace("\\", "/"))))
        candidates = [] if given is None else [given]
        for candidate in (*candidates, *picture_paths(self.folder, name)):
            if candidate.is_file():
                return size_of(candidate)
        return None


def picture_paths(folder: Path, name: str) -> list[Path]:
    """Where the picture that a camera names may lie, seen from a folder: names may lack the suffix."""
    beside = os.path.join(folder, name.replace("\\", "/"))
    return [Path(beside + suffix) for suffix in ("", *SUFFIXES)]


def size_of(picture: Path) -> tuple[int, int]:
    """Width and height of a picture, upright, from its header; raises InputError if it cannot be read."""
    return image_size(picture)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder in the order of their names, character by character; none where there is none."""
    if not folder.is_dir() or not any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return []
    return sorted(find_images([folder]))
