"""Damaged camera files: cameras or an InputError, whatever they hold; never another exception, a crash or a wait."""

import re

import numpy as np
import pytest
from camera_cases import (
    CENTRED,
    K,
    as_cam_txt,
    as_llff,
    as_re10k,
    colmap_model,
    known,
    save_images,
    write_stereo,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.cameras.formats import colmap as cameras_colmap
from idesplat.runtime.cameras.io import CameraFormat, read_cameras
from idesplat.runtime.errors import InputError

NAMES = ["100.png", "200.png"]
# Numbers that break what trusts them: as text, and as the bytes of counts and coordinates.
WORDS = [
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "1e30",
    "x",
    "",
    "%",
    "- !!opencv-matrix",
    "rows: 99999999",
    "[",
    "]",
    "\x00",
]
NUMBERS = st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1e300, 1e-300, 2.0**62])
quick = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def image_paths(tmp_path_factory):
    return save_images(tmp_path_factory.mktemp("images"), NAMES, 64, 48)


def small(names=NAMES, matrix=K):
    return known(names, matrix)


def content(form, folder):
    """A good file of the format, as bytes."""
    if form is CameraFormat.RE10K:
        return as_re10k(small(["100", "200"])).encode()
    if form is CameraFormat.DTU:
        return as_cam_txt(small()[0], K, "425.0 2.5 192 935").encode()
    path = folder / ("good.npy" if form is CameraFormat.LLFF else "good.yml")
    if form is CameraFormat.LLFF:
        np.save(path, as_llff(small(NAMES, CENTRED)))
    else:
        write_stereo(path, size="numbers")
    return path.read_bytes()


FILE_NAMES = {
    CameraFormat.RE10K: "re10k.txt",
    CameraFormat.DTU: "100_cam.txt",
    CameraFormat.LLFF: "poses_bounds.npy",
    CameraFormat.OPENCV: "stereo.yml",
}


def assert_cameras_or_input_error(path, image_paths, form):
    try:
        cameras = read_cameras(path, image_paths, form)
    except InputError as error:
        assert str(error).startswith(str(path))
        return
    for camera in cameras:
        assert np.isfinite(camera.K).all() and np.isfinite(camera.extrinsics).all()
        assert camera.width > 0 and camera.height > 0 and camera.K[0, 0] > 0


@quick
@given(data=st.data())
@pytest.mark.parametrize("form", FILE_NAMES)
def test_mutated_bytes(tmp_path, image_paths, form, data):
    mutated = bytearray(content(form, tmp_path))
    if data.draw(st.booleans()):
        del mutated[data.draw(st.integers(0, len(mutated))) :]
    for _ in range(data.draw(st.integers(0, 4))):
        start = data.draw(st.integers(0, len(mutated)))
        mutated[start : start + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    path = tmp_path / FILE_NAMES[form]
    path.write_bytes(mutated)
    assert_cameras_or_input_error(path, image_paths, data.draw(st.sampled_from([form, None])))


@quick
@given(data=st.data())
@pytest.mark.parametrize("form", [CameraFormat.RE10K, CameraFormat.DTU, CameraFormat.OPENCV])
def test_mutated_words(tmp_path, image_paths, form, data):
    words = re.split(r"(\s+)", content(form, tmp_path).decode())
    for _ in range(data.draw(st.integers(1, 4))):
        words[data.draw(st.integers(0, len(words) - 1))] = data.draw(st.sampled_from(WORDS))
    path = tmp_path / FILE_NAMES[form]
    path.write_text("".join(words))
    assert_cameras_or_input_error(path, image_paths, data.draw(st.sampled_from([form, None])))


@quick
@given(data=st.data())
def test_mutated_numbers_of_llff(tmp_path, image_paths, data):
    rows = as_llff(small(NAMES, CENTRED))
    for _ in range(data.draw(st.integers(1, 4))):
        rows[data.draw(st.integers(0, 1)), data.draw(st.integers(0, 16))] = data.draw(NUMBERS)
    with np.errstate(over="ignore"):
        rows = rows.astype(data.draw(st.sampled_from(["f8", "f4", ">f8", "f2", "c16", "O"])))
    shape = data.draw(st.sampled_from([(2, 17), (17, 2), (34,), (2, 17, 1), (1, 34)]))
    np.save(tmp_path / "poses_bounds.npy", rows.reshape(shape))
    assert_cameras_or_input_error(tmp_path / "poses_bounds.npy", image_paths, None)


# ---- COLMAP's library is in a process of its own, which takes half a second


@pytest.mark.slow
@settings(quick, max_examples=12)
@given(data=st.data())
@pytest.mark.parametrize("kind", ["binary", "text"])
def test_mutated_colmap(tmp_path, monkeypatch, kind, data):
    monkeypatch.setattr(cameras_colmap, "CPU_SECONDS", 6)
    model = colmap_model(small())
    model.write_binary(tmp_path) if kind == "binary" else model.write_text(tmp_path)
    path = data.draw(st.sampled_from(sorted(path for path in tmp_path.iterdir() if path.is_file())))
    mutated = bytearray(path.read_bytes())
    if data.draw(st.integers(0, 3)) == 0:
        del mutated[data.draw(st.integers(0, len(mutated))) :]
    for _ in range(data.draw(st.integers(0, 3))):
        start = data.draw(st.integers(0, min(len(mutated), data.draw(st.sampled_from([16, 10_000])))))
        mutated[start : start + 4] = data.draw(st.binary(min_size=1, max_size=8))
    path.write_bytes(mutated)
    assert_cameras_or_input_error(tmp_path, (), None)


@pytest.mark.parametrize("part", ["cameras", "images", "frames", "rigs", "points3D"])
@pytest.mark.parametrize("count", [2**63, 2**40, 2**24])
def test_colmap_counts_that_promise_too_much(tmp_path, part, count):
    colmap_model(small()).write_binary(tmp_path)
    path = tmp_path / f"{part}.bin"
    path.write_bytes(count.to_bytes(8, "little") + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{part}\.bin .*truncated or damaged"):
        read_cameras(tmp_path)
