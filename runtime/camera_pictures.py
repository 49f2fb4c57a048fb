"""The pictures that a camera file leaves unnamed or unmeasured: among those that were given, or beside the file."""

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from .images import SUFFIXES, find_images, load_image, stem

GIVE_PICTURES = "give the pictures with --images, which idesplat-cameras convert takes, too"


def picture_size(name: str, folder: Path, pictures: Sequence[Path]) -> tuple[int, int] | None:
    """Width and height of the picture that a camera names, or None where there is no such picture.

    It is the one among `pictures` with that name, whatever the suffix, or else a file relative to `folder`.
    Raises InputError if the picture cannot be read.
    """
    wanted = stem(PurePosixPath(name.replace("\\", "/")))
    given = [picture for picture in pictures if stem(picture) == wanted]
    beside = os.path.join(folder, name.replace("\\", "/"))
    candidates = [*given, *(Path(beside + suffix) for suffix in ("", *SUFFIXES))]
    for candidate in candidates:
        if os.path.isfile(candidate):
            return size_of(candidate)
    return None


def size_of(picture: Path) -> tuple[int, int]:
    """Width and height of a picture, upright; raises InputError if it cannot be read."""
    height, width = load_image(picture).shape[:2]
    return width, height


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder in the order of their names, character by character; none where there is none."""
    if not folder.is_dir() or not any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return []
    return sorted(find_images([folder]))
