"""Frames of a video: sharp ones, evenly spaced, and those that cameras name."""

import cv2
import numpy as np
import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.images import video_reader as video
from idesplat.runtime.images.io import load_image


@pytest.fixture
def clip(tmp_path):
    """A video of 60 frames; each is as grey as its number times 4, and every fifth, from the third on, is sharp."""
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30, (96, 64))
    for number in range(60):
        frame = np.full((64, 96, 3), 4 * number, np.uint8)
        if number % 5 == 3:
            frame[16:48:4, 20:76] += 15
        writer.write(frame)
    writer.release()
    return path


def greys(files):
    return [round(float(load_image(file)[:8].mean()) / 4) for file in files]


def test_sharp_frames_at_even_steps(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "FRAMES", 12)
    out = tmp_path / "frames"
    out.mkdir()
    files = video.extract_sharp_frames(clip, out)
    assert [file.name for file in files] == [f"clip-{number:06}.png" for number in range(3, 60, 5)]
    assert greys(files) == list(range(3, 60, 5))


def test_named_frames_by_number_and_by_time(clip, tmp_path):
    files = video.extract_named_frames(clip, ["images/clip-000007.png", "clip-000040", "other-000001.png"], tmp_path)
    assert [file.name for file in files] == ["clip-000007.png", "clip-000040.png"]
    assert greys(files) == [7, 40]
    files = video.extract_named_frames(
        clip, ["100000", "1000000", "1500000"], tmp_path
    )  # microseconds, 30 frames a second
    assert [file.name for file in files] == ["100000.png", "1000000.png", "1500000.png"]
    assert greys(files) == [3, 30, 45]


def test_named_frames_are_not_too_many(clip, tmp_path):
    files = video.extract_named_frames(clip, [f"clip-{number:06}" for number in range(60)], tmp_path)
    assert len(files) == video.FRAMES
    assert greys(files)[0] == 0 and greys(files)[-1] == 59


def test_mistakes(clip, tmp_path):
    (tmp_path / "text.mp4").write_text("hello")
    (tmp_path / "cut.avi").write_bytes(clip.read_bytes()[:3000])
    (tmp_path / "empty.mp4").write_bytes(b"")
    for name, expected in (
        ("text.mp4", "damaged or not a video"),
        ("empty.mp4", "damaged or not a video"),
        ("absent.mp4", "no such file"),
    ):
        with pytest.raises(InputError, match=expected):
            video.extract_sharp_frames(tmp_path / name, tmp_path)
    with pytest.raises(InputError, match=r"clip\.avi: the cameras do not name its frames, such as clip-000000\.png"):
        video.extract_named_frames(clip, ["a.png", "other-000003.png"], tmp_path)
    with pytest.raises(InputError, match=r"clip\.avi: has none of the 2 frames that the cameras name, such as clip-0"):
        video.extract_named_frames(clip, ["clip-000900.png", "clip-000901.png"], tmp_path)
    with pytest.raises(InputError, match="the cameras do not name its frames"):  # but images of another capture
        video.extract_named_frames(clip, ["0001.jpg", "0002.jpg", "0007.jpg"], tmp_path)
    with pytest.raises(InputError, match=r"damaged|expected two at least"):
        video.extract_sharp_frames(tmp_path / "cut.avi", tmp_path)


def test_frames_larger_than_the_limit_are_refused(tmp_path, monkeypatch):
    writer = cv2.VideoWriter(str(tmp_path / "large.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (1200, 900))
    for _ in range(2):
        writer.write(np.zeros((900, 1200, 3), np.uint8))
    writer.release()
    monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", "1")
    with pytest.raises(InputError, match=r"large\.avi: has 1200 x 900 pixels, .*IDESPLAT_MAX_MEGAPIXELS"):
        video.extract_sharp_frames(tmp_path / "large.avi", tmp_path)


def test_names_of_cameras_are_no_numbers_of_any_length(clip, tmp_path):
    names = ["clip-" + "9" * 5000, "9" * 5000, "²", "clip-000003", "clip-000005"]
    files = video.extract_named_frames(clip, names, tmp_path)
    assert [file.name for file in files] == ["clip-000003.png", "clip-000005.png"]
