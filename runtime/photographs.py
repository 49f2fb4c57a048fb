"""What --images stands for: photographs, or the frames of a video that cameras name."""

from collections.abc import Sequence
from pathlib import Path

from . import video
from .camera_format import CameraFormat
from .cameras import read_cameras, recognise
from .cameras_re10k import timestamps
from .errors import InputError
from .images import find_images


def find_photographs(
    given: Sequence[Path], cameras: Path | None, camera_format: CameraFormat | None, folder: Path
) -> list[Path]:
    """The photographs that are given, or frames of a video, written to `folder`.

    cameras: where frames of a video are named; None for sharp ones. Raises InputError for what cannot be read, or a
    video that is not alone.
    """
    videos = [path for path in given if video.is_video(path)]
    if not videos:
        return find_images(given)
    if len(given) > 1:
        raise InputError(f"{videos[0]}: a video and {len(given) - 1} other images given, expected it alone")
    if cameras is None:
        return video.sample_frames(videos[0], folder)
    return video.named_frames(videos[0], _names(cameras, camera_format), folder)


def _names(cameras: Path, camera_format: CameraFormat | None) -> list[str]:
    """The pictures that a file of cameras names, before any picture is there."""
    if (camera_format or recognise(cameras)) is CameraFormat.RE10K:
        return timestamps(cameras)
    return [camera.name for camera in read_cameras(cameras, (), camera_format)]
