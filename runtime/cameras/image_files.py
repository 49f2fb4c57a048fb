"""Finding the images of a camera file, among given images or beside the file, for names and sizes that it lacks."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path, PurePosixPath

from ..images.finding import SUFFIXES, find_images, image_stem
from ..images.header import image_size

GIVE_IMAGES = "give the images with --images, which idesplat cameras convert takes, too"
# Datasets keep images in the folder of the camera file, or in these subfolders of it or of a parent: COLMAP models lie
# in `sparse/0`.
IMAGE_FOLDERS = ("images", "image", "blended_images")
MAX_PARENTS = 3

_CONFINED: ContextVar[Path | None] = ContextVar("_CONFINED", default=None)


@contextmanager
def confine_to(folder: Path) -> Iterator[None]:
    """In the block, look for images in this folder alone, whatever paths a camera file names.

    For cameras of somebody who may not learn which other images there are.
    """
    token = _CONFINED.set(folder.resolve())
    try:
        yield
    finally:
        _CONFINED.reset(token)


def image_roots(cameras: Path) -> list[Path]:
    """The folder of a camera file (or `cameras` itself, if it is a folder) and its parents that may hold the images."""
    folder = cameras if os.path.isdir(cameras) else cameras.parent
    return [folder, *filter(_is_allowed, folder.resolve().parents[:MAX_PARENTS])]


class ImageSizes:
    """Sizes of the images that cameras name.

    An image is found among `images` by its name without suffix, or else as a path relative to `folder`.
    """

    def __init__(self, folder: Path, images: Sequence[Path]) -> None:
        self.folder = folder
        self._given = {image_stem(image): image for image in reversed(images)}

    def size(self, name: str) -> tuple[int, int] | None:
        """Width and height of the image with this name, or None if it is not found.

        Raises InputError if the image cannot be read.
        """
        given = self._given.get(image_stem(PurePosixPath(name.replace("\\", "/"))))
        candidates = [] if given is None else [given]
        for candidate in (*candidates, *candidate_paths(self.folder, name)):
            if os.path.isfile(candidate):  # a name may be too long for a file's
                return image_size(candidate)
        return None


def candidate_paths(folder: Path, name: str) -> list[Path]:
    """Paths of an image in a folder, by a name that may lack the suffix."""
    beside = os.path.join(folder, name.replace("\\", "/"))
    return [path for suffix in ("", *SUFFIXES) if _is_allowed(path := Path(beside + suffix))]


def images_in_folder(folder: Path) -> list[Path]:
    """The images of a folder, sorted by name as text (not naturally); empty if there is no such folder."""
    if not folder.is_dir() or not any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return []
    return sorted(find_images([folder]))


def _is_allowed(path: Path) -> bool:
    root = _CONFINED.get()
    return root is None or Path(os.path.realpath(path)).is_relative_to(root)
