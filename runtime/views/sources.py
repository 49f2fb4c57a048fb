"""What --images stands for: photographs, the frames of a video that cameras name, or what cameras themselves name."""

from collections.abc import Sequence
from pathlib import Path

from ..cameras.format_names import CameraFormat
from ..cameras.formats.re10k import timestamps
from ..cameras.image_files import IMAGE_FOLDERS, candidate_paths, image_roots
from ..cameras.io import detect_format, read_cameras
from ..errors import InputError
from ..images import video_reader as video
from ..images.io import find_images

EXAMPLES = 3  # names in a message


def find_input_images(
    given: Sequence[Path], cameras: Path | None, camera_format: CameraFormat | None, folder: Path
) -> list[Path]:
    """The photographs that are given, or frames of a video, written to `folder`; where none are, those of the cameras.

    cameras: where frames of a video are named; None for sharp ones. Raises InputError for what cannot be read or found,
    or a video that is not alone.
    """
    if not given:
        return _named_photographs(cameras, camera_format)
    videos = [path for path in given if video.is_video(path)]
    if not videos:
        return find_images(given)
    if len(given) > 1:
        raise InputError(f"{videos[0]}: a video and {len(given) - 1} other images given, expected it alone")
    if cameras is None:
        return video.extract_sharp_frames(videos[0], folder)
    return video.extract_named_frames(videos[0], _names(cameras, camera_format), folder)


def _named_photographs(cameras: Path | None, camera_format: CameraFormat | None) -> list[Path]:
    """The photographs that cameras name, as far as they are there; raises InputError where none is."""
    if cameras is None:
        raise InputError("--images is missing: photographs without cameras are to be given")
    names = _names(cameras, camera_format)
    roots = image_roots(cameras)
    for place in (roots[0], *(root / name for root in roots for name in IMAGE_FOLDERS)):
        found = [path for name in names if (path := _file(place, name)) is not None]
        if found:
            return found
    shown = ", ".join(names[:EXAMPLES]) + (", ..." if len(names) > EXAMPLES else "")
    raise InputError(
        f"{cameras}: none of the {len(names)} images that it names ({shown}) is beside it or in `{IMAGE_FOLDERS[0]}`; "
        "give --images"
    )


def _file(place: Path, name: str) -> Path | None:
    """The image of this name, with its suffix or without, in a folder."""
    return next((path for path in candidate_paths(place, name) if path.is_file()), None)


def _names(cameras: Path, camera_format: CameraFormat | None) -> list[str]:
    """The pictures that a file of cameras names, before any picture is there."""
    if (camera_format or detect_format(cameras)) is CameraFormat.RE10K:
        return timestamps(cameras)
    return [camera.name for camera in read_cameras(cameras, (), camera_format)]
