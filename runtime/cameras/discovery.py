"""Images and cameras that belong together, where only the images are given."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from ..images.finding import SUFFIXES, is_video
from ..system.output_names import CAMERAS_FILE
from .image_files import IMAGE_FOLDERS
from .io import detect_format

LOG = logging.getLogger(__name__)

BESIDE_VIDEO = (".json", ".txt")  # endings of cameras that are called like a video


class Found(NamedTuple):
    """images: what to read. cameras: their file or folder; None where there is none. note: what was found, in words."""

    images: list[Path]
    cameras: Path | None
    note: str


def find_cameras(images: Sequence[Path]) -> Found:
    """The cameras beside images of which nothing else is known.

    images: folders, globs, files or a video. A folder without images of its own stands for the images in its folder
    `images` (see `IMAGE_FOLDERS`). Cameras are looked for in the images' folder and in the one above it: whatever
    `detect_format` knows a folder of cameras by (transforms.json, a COLMAP model as in `sparse/0`, poses_bounds.npy,
    *_cam.txt), or `cameras.json`. Of a video they are a file of its name.
    """
    given = [Path(image) for image in images]
    if len(given) == 1 and given[0].is_dir() and not _has_images(given[0]):
        below = [given[0] / name for name in IMAGE_FOLDERS if _has_images(given[0] / name)]
        given = below[:1] or given
    cameras = _beside(given[0]) if given else None
    LOG.info("cameras beside %s: %s", ", ".join(map(str, given)), cameras or "none")
    if cameras is None:
        return Found(given, None, "no cameras beside the photographs, so they are estimated (--cameras to give them)")
    return Found(given, cameras, f"cameras found beside the photographs: {cameras} (--cameras to give others)")


def _beside(image: Path) -> Path | None:
    """The cameras beside a folder of images, or beside an image, a glob or a video."""
    if image.is_file() and is_video(image):
        return next((path for end in BESIDE_VIDEO if _is_known(path := image.with_suffix(end))), None)
    folder = image if image.is_dir() else image.parent
    above = folder / ".." if folder == Path() or folder.name == ".." else folder.parent
    for place in (folder, above):
        for candidate in (place, place / CAMERAS_FILE):
            if _is_known(candidate):
                return candidate
    return None


def _is_known(path: Path) -> bool:
    """Whether this is a file or folder of cameras."""
    if not os.path.exists(path):
        return False
    try:
        detect_format(path)
    except InputError:
        return False
    return True


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(path.suffix.lower() in SUFFIXES for path in folder.iterdir())
