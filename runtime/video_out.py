"""Videos out: .mp4 files that every browser plays, and that appear whole or not at all."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from .errors import InputError
from .files import replacing
from .images_out import to_bytes

CODEC = "vp09"  # what OpenCV's packages hold; their H.264 needs libraries that cannot be shipped along


@contextmanager
def open_video(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that adds a frame, RGB in [0, 1], [height, width, 3]; the video appears when the block ends.

    Sides that are odd lose their last pixel, as video wants it. Raises InputError if no video can be written.
    """
    import cv2

    with replacing(path) as temporary:
        size = (width - width % 2, height - height % 2)
        writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*CODEC), fps, size)
        if not writer.isOpened():
            raise InputError(f"cannot write {path}: this OpenCV has no encoder for {CODEC}; give a folder for pictures")
        frames = 0

        def add(rgb: np.ndarray) -> None:
            nonlocal frames
            writer.write(np.ascontiguousarray(to_bytes(rgb)[: size[1], : size[0], ::-1]))
            frames += 1

        try:
            yield add
        finally:
            writer.release()
        # OpenCV does not say when a disk is full.
        if int(cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)) != frames:
            raise InputError(f"cannot write {path}: not all frames arrived; choose a file on a disk with room for it")
