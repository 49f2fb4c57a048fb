"""RealEstate10K trajectories: a line with the URL of the video, then one line for each frame.

    timestamp fx fy cx cy 0 0 w2c     microseconds; intrinsics normalised by the image size; world-to-camera, 3 x 4

Poses have OpenCV axes. The name of an image is the timestamp of its frame. The file does not store the image size, so
at least one image must be given or lie beside the file.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import denormalize_intrinsics, intrinsic_matrix
from ...geometry.rigid import invert_rigid
from ..camera import Camera
from ..image_files import GIVE_IMAGES, ImageSizes
from ..parsing import numbers, read_text
from ..source import CameraSource

DESCRIPTION = "a RealEstate10K trajectory"
COLUMNS = 19


def detect(source: CameraSource) -> bool:
    """Whether one of the first two lines has as many words as a frame's line."""
    return any(len(line.split()) == COLUMNS for line in source.start.splitlines()[:2])


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file. images: one of them gives the image size. Raises InputError."""
    rows = _rows(path)
    width, height = _size([name for _, name, _ in rows], path.parent, images)
    cameras = []
    for number, name, values in rows:
        with error_context(f"line {number} (frame {name})"):
            K = denormalize_intrinsics(intrinsic_matrix(*values[:4]), width, height)
            pose = np.vstack([values[6:].reshape(3, 4), (0, 0, 0, 1)])
            cameras.append(Camera(name, width, height, K, invert_rigid(pose)))
    return cameras


def read_image_names(path: Path) -> list[str]:
    """The timestamps of the frames, which need no image. Raises InputError."""
    return [name for _, name, _ in _rows(path)]


def _rows(path: Path) -> list[tuple[int, str, np.ndarray]]:
    """Line number, timestamp and 18 numbers of each frame."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or (number == 1 and len(words) == 1):  # the URL
            continue
        with error_context(f"line {number}"):
            if len(words) != COLUMNS:
                raise InputError(
                    f"has {len(words)} words, expected {COLUMNS}: timestamp fx fy cx cy 0 0 and a 3 x 4 pose"
                )
            rows.append((number, words[0], np.array(numbers(words[1:]))))
    if not rows:
        raise InputError("holds no frame, expected lines of a timestamp and 18 numbers")
    return rows


def _size(names: Sequence[str], folder: Path, images: Sequence[Path]) -> tuple[int, int]:
    """The image size, of the first frame with an image: all frames are from one video."""
    sizes = ImageSizes(folder, images)
    for name in names:
        size = sizes.size(name)
        if size is not None:
            return size
    raise InputError(
        f"has no image size, and no image is named by one of its {len(names)} timestamps, such as {names[0]}; "
        + GIVE_IMAGES
    )
