"""The input images: image files, frames extracted from a video, or the images that a camera file names."""

import os
from collections.abc import Sequence
from pathlib import Path

from ..cameras.formats import CameraFormat
from ..cameras.image_files import IMAGE_FOLDERS, candidate_paths, image_roots
from ..cameras.io import read_image_names
from ..errors import InputError
from ..images import video_reader
from ..images.finding import find_images, is_video

EXAMPLES = 3  # names in a message


def find_input_images(
    given: Sequence[Path], cameras: Path | None, camera_format: CameraFormat | None, folder: Path
) -> list[Path]:
    """Paths of the input images.

    given: folders, globs and files; or one video, whose frames are written to `folder`; or nothing, for the images that
    the cameras name, beside their file.
    cameras: a file or folder of cameras, which names the frames of a video; None for sharp, evenly spaced frames.
    Raises InputError if an image is missing or not readable, or if anything else is given with a video.
    """
    if not given:
        return _images_of_cameras(cameras, camera_format)
    videos = [path for path in given if is_video(path)]
    if not videos:
        return find_images(given)
    if len(given) > 1:
        raise InputError(f"{videos[0]}: a video and {len(given) - 1} other inputs given; give the video alone")
    if cameras is None:
        return video_reader.extract_sharp_frames(videos[0], folder)
    return video_reader.extract_named_frames(videos[0], read_image_names(cameras, camera_format), folder)


def _images_of_cameras(cameras: Path | None, camera_format: CameraFormat | None) -> list[Path]:
    """The images that the cameras name and that exist. Raises InputError if none exists."""
    if cameras is None:
        raise InputError("--images is missing; give the images, or --cameras with a file that names them")
    names = read_image_names(cameras, camera_format)
    roots = image_roots(cameras)
    for folder in (roots[0], *(root / name for root in roots for name in IMAGE_FOLDERS)):
        found = [path for name in names if (path := _find(folder, name)) is not None]
        if found:
            return found
    shown = ", ".join(names[:EXAMPLES]) + (", ..." if len(names) > EXAMPLES else "")
    raise InputError(
        f"{cameras}: none of the {len(names)} images that it names ({shown}) is beside it or in `{IMAGE_FOLDERS[0]}`; "
        "give --images"
    )


def _find(folder: Path, name: str) -> Path | None:
    """The image of this name, which may lack the suffix, in a folder."""
    return next((path for path in candidate_paths(folder, name) if os.path.isfile(path)), None)
