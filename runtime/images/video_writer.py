"""Writing videos as H.264 in .mp4 with PyAV (extra `video`), atomically.

4:2:0 chroma and BT.709 colours, which players expect; the index precedes the frames, so that playback can start while
the file is loading.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from ..errors import InputError
from ..system.files import atomic_write
from .colormaps import to_uint8

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

CODEC, PIXELS = "libx264", "yuv420p"
CONSTANT_QUALITY = "18"  # x264's crf: visually near lossless
FAST_START = {"movflags": "+faststart"}
LARGEST_DENOMINATOR = 1001  # of the frame rate, such as 30000/1001
BT709, LIMITED_RANGE = 1, 1  # in the numbers of ITU-T H.273, and of FFmpeg's AVColorRange
INSTALL = "pip install 'idesplat[video]'"


def check_video_support() -> None:
    """Raise InputError if PyAV is not installed."""
    if find_spec("av") is None:
        raise InputError(f"writing an .mp4 needs PyAV, which is not installed; {INSTALL}, or give a folder for images")


@contextmanager
def open_video(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that adds a frame, RGB in [0, 1], [height, width, 3]; the video appears when the block ends.

    Odd sides are padded by repeating the last pixels, since the codec requires even sides. Raises InputError if the
    video cannot be written.
    """
    check_video_support()
    import av

    padding = ((0, height % 2), (0, width % 2), (0, 0))
    try:
        with (
            atomic_write(path) as temporary,
            av.open(str(temporary), "w", format="mp4", options=FAST_START) as container,
        ):
            rate = Fraction(fps).limit_denominator(LARGEST_DENOMINATOR)
            stream = _stream(container, rate, width + width % 2, height + height % 2)

            def add(rgb: np.ndarray) -> None:
                pixels = np.pad(to_uint8(rgb), padding, mode="edge")
                frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                container.mux(stream.encode(frame.reformat(format=PIXELS, dst_colorspace="ITU709")))

            yield add
            container.mux(stream.encode())
    except av.FFmpegError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; give another --size, or a disk with room") from None


def _stream(container: "OutputContainer", rate: Fraction, width: int, height: int) -> "VideoStream":
    """The container's one stream."""
    stream = cast("VideoStream", container.add_stream(CODEC, rate))
    stream.width, stream.height, stream.pix_fmt = width, height, PIXELS
    stream.options = {"crf": CONSTANT_QUALITY}
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED_RANGE
    return stream
