"""Extracting frames from videos as PNG files: sharp, evenly spaced frames, or the frames that cameras name.

A file is named `<video>-<frame number>.png`, with frames numbered from 0.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from ..errors import InputError
from ..system.files import check_regular
from ..system.limits import parse_whole_number
from ..system.progress import working
from .header import check_megapixels

FRAMES = 20
CANDIDATES = 15  # frames considered for each one that is extracted
SHARPNESS_SIDE = 480  # pixels, at which sharpness is measured
NUMBERED = re.compile(r"(.+)-(\d{6,})")


def extract_sharp_frames(video: Path, folder: Path) -> list[Path]:
    """Write the sharpest frame of each of FRAMES equal parts of a video to a folder; the files in order.

    Raises InputError if the video cannot be read or has fewer than two frames.
    """
    with working("selecting sharp frames"):
        sharpness = dict(_sharpness(video))
    if len(sharpness) < 2:
        raise InputError(f"{video}: has {len(sharpness)} frames that can be read, expected two at least")
    parts = np.array_split(list(sharpness), min(FRAMES, len(sharpness)))
    best = [int(max(part, key=lambda number: sharpness[number])) for part in parts]
    return _write_frames(video, {number: f"{video.stem}-{number:06}.png" for number in best}, folder)


def extract_named_frames(video: Path, names: Sequence[str], folder: Path) -> list[Path]:
    """Write the frames that cameras name to a folder, at most FRAMES, evenly spaced, under the names in `names`.

    A name is `<video>-<number>`, as `extract_sharp_frames` names files, or a time in microseconds, as in RealEstate10K.
    Raises InputError if the video cannot be read or has none of the frames, or no name is of these kinds.
    """
    rate = _frame_rate(video)
    name_of = {number: f"{_stem(name)}.png" for name in names if (number := _number(name, video, rate)) is not None}
    if len(name_of) < min(2, len(names)):  # image numbers can look like timestamps of the first microseconds
        raise InputError(
            f"{video}: the cameras do not name its frames, such as {video.stem}-000000.png or a time in microseconds; "
            "give the images that the cameras were made for, or --cameras estimate"
        )
    spread = np.linspace(0, len(name_of) - 1, min(FRAMES, len(name_of))).round().astype(int)
    taken = [sorted(name_of)[index] for index in spread]
    written = _write_frames(video, {number: name_of[number] for number in taken}, folder)
    if not written:
        raise InputError(
            f"{video}: has none of the {len(name_of)} frames that the cameras name, such as {name_of[taken[0]]}; "
            "give the video that the cameras were made for, or --cameras estimate"
        )
    return written


def _write_frames(video: Path, name_of: Mapping[int, str], folder: Path) -> list[Path]:
    """Write the frames with these numbers under these names; returns the files of the frames that exist, in order."""
    written = []
    for number, capture in _frames(video):
        if number in name_of:
            done, frame = capture.retrieve()
            if done:
                written.append(folder / name_of[number])
                cv2.imwrite(str(written[-1]), frame)
        if number >= max(name_of):
            break
    return written


def _sharpness(video: Path) -> Iterator[tuple[int, float]]:
    """Number and sharpness of frames spread over a video."""
    step = 1
    for number, capture in _frames(video):
        if number == 0:
            step = max(1, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) // (FRAMES * CANDIDATES))
        if number % step == 0:
            done, frame = capture.retrieve()
            if done:
                yield number, _sharpness_of(frame)


def _sharpness_of(frame: np.ndarray) -> float:
    """Variance of the Laplacian of the frame, reduced and in grey."""
    scale = min(1.0, SHARPNESS_SIDE / max(frame.shape[:2]))
    grey = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _frames(video: Path) -> Iterator[tuple[int, cv2.VideoCapture]]:
    """The number of each frame, and the capture to retrieve it from."""
    try:
        check_regular(video)
    except FileNotFoundError:
        raise InputError(f"{video}: no such file, expected a video") from None
    except OSError as error:
        raise InputError(f"{video}: cannot be read ({error.strerror}); expected a video") from None
    capture = cv2.VideoCapture(str(video))
    try:
        if capture.isOpened():
            sides = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            check_megapixels(str(video), *sides)
        if not capture.isOpened() or not capture.grab():
            raise InputError(f"{video}: is damaged or not a video that OpenCV reads; save it as MP4 (H.264)")
        number = 0
        yield number, capture
        while capture.grab():
            number += 1
            yield number, capture
    finally:
        capture.release()


def _frame_rate(video: Path) -> float:
    """Frames per second, 0 if unknown."""
    for _, capture in _frames(video):
        return max(0.0, capture.get(cv2.CAP_PROP_FPS))
    return 0.0


def _number(name: str, video: Path, rate: float) -> int | None:
    """The number of the frame that a camera names, or None if the name is not of this video."""
    stem = _stem(name)
    numbered = NUMBERED.fullmatch(stem)
    if numbered and numbered[1] == video.stem:
        return parse_whole_number(numbered[2])
    microseconds = parse_whole_number(stem)
    return round(microseconds * rate / 1e6) if microseconds is not None and rate else None


def _stem(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem
