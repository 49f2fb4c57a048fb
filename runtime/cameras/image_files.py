"""The images that a camera file leaves unnamed or unmeasured: among those that were given, or beside the file."""

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from ..images.header import image_size
from ..images.io import SUFFIXES, find_images, image_stem

GIVE_IMAGES = "give the images with --images, which idesplat-cameras convert takes, too"


# Where datasets keep the images that a camera file names: in its own folder, and in these of it and of those above,
# since COLMAP's models lie in `sparse/0`.
IMAGE_FOLDERS = ("images", "image", "blended_images")
FOLDERS_ABOVE = 3


def image_roots(cameras: Path) -> list[Path]:
    """The folder of a camera file, or the folder of cameras itself, and those above it that may hold its images."""
    folder = cameras if os.path.isdir(cameras) else cameras.parent
    return [folder, *folder.resolve().parents[:FOLDERS_ABOVE]]


class ImageSizes:
    """Sizes of the images that cameras name.

    An image is the one among `images` with that name, whatever the suffix, or else a file relative to `folder`.
    """

    def __init__(self, folder: Path, images: Sequence[Path]) -> None:
        self.folder = folder
        self._given = {image_stem(image): image for image in reversed(images)}

    def size(self, name: str) -> tuple[int, int] | None:
        """Width and height of the image that a camera names, or None where there is no such image.

        Raises InputError if the image cannot be read.
        """
        given = self._given.get(image_stem(PurePosixPath(name.replace("\\", "/"))))
        candidates = [] if given is None else [given]
        for candidate in (*candidates, *candidate_paths(self.folder, name)):
            if candidate.is_file():
                return image_size(candidate)
        return None


def candidate_paths(folder: Path, name: str) -> list[Path]:
    """Where the image that a camera names may lie, seen from a folder: names may lack the suffix."""
    beside = os.path.join(folder, name.replace("\\", "/"))
    return [Path(beside + suffix) for suffix in ("", *SUFFIXES)]


def images_in_folder(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, character by character; none where there is none."""
    if not folder.is_dir() or not any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return []
    return sorted(find_images([folder]))
