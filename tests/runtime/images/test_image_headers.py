"""Images judged by their headers: sizes, limits, damage, HEIC; and how often they are decoded."""

import io
import struct
import subprocess
import sys
import warnings
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.errors import InputError
from idesplat.runtime.images import io as images
from idesplat.runtime.images.exif import exif_focal
from idesplat.runtime.images.header import DamagedImage, image_size
from idesplat.runtime.images.io import load_image
from PIL import Image
from scene_files import HEIC

UPRIGHT = np.array(
    [[[250, 10, 10], [10, 250, 10]], [[10, 10, 250], [250, 250, 250]], [[128, 128, 128], [5, 5, 5]]], np.uint8
)
# What is stored so that an EXIF orientation turns it upright.
STORED = {
    1: lambda up: up,
    3: lambda up: up[::-1, ::-1],
    6: lambda up: np.rot90(up, 1),
    7: lambda up: up[::-1, ::-1].transpose(1, 0, 2),
}
ORIENTATION = 0x0112


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_of_zeros(width: int, height: int, depth: int, colour: int, bytes_a_row: int) -> bytes:
    packer, row = zlib.compressobj(9), bytes(bytes_a_row + 1)
    packed = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def tiff_of_zeros(width: int, height: int) -> bytes:
    """An LZW TIFF in RGB of one strip, whose codes run out early: its header alone is read."""
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 5), (262, 3, 2), (277, 3, 3), (278, 4, height)]
    entries += [(273, 4, 200), (279, 4, 6_000_000)]
    directory = struct.pack("<H", len(entries))
    for tag, kind, value in sorted(entries):
        directory += struct.pack("<HHII", tag, kind, 1, value)
    content = struct.pack("<2sHI", b"II", 42, 8) + directory + bytes(4)
    return content.ljust(200, b"\0") + bytes(6_000_000)


BOMBS = {
    "rgba.png": lambda: png_of_zeros(20_000, 20_000, 8, 6, 80_000),
    "one-bit.png": lambda: png_of_zeros(32_000, 32_000, 1, 0, 4_000),
    "lzw.tif": lambda: tiff_of_zeros(40_000, 50_000),
}
MEASURE = """
import resource, sys
from idesplat.runtime.images.io import load_image
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    load_image(sys.argv[1])
except ValueError as error:
    print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_with_little_memory(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(BOMBS[name]())
    assert path.stat().st_size < 7_000_000
    done = subprocess.run([sys.executable, "-c", MEASURE, path], capture_output=True, text=True, check=True)
    message, grown = done.stdout.splitlines()
    assert "pixels, expected 256 megapixels at most" in message and "IDESPLAT_MAX_MEGAPIXELS" in message
    assert done.stderr == ""
    assert int(grown) < 100 * (1024 if sys.platform != "darwin" else 1024**2)  # 100 MiB


def test_the_limit_can_be_raised_and_lowered(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((1000, 1100, 3), np.uint8))
    monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", "1")
    for read in (load_image, image_size):
        with pytest.raises(
            InputError, match=r"1100 x 1000 pixels.*set the environment variable IDESPLAT_MAX_MEGAPIXELS"
        ):
            read(tmp_path / "a.png")
    monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", "2")
    assert load_image(tmp_path / "a.png").shape == (1000, 1100, 3)
    for text in ("0", "-1", "²", "many", "9" * 30):
        monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", text)
        with pytest.raises(InputError, match=r"IDESPLAT_MAX_MEGAPIXELS=.*expected a whole number of megapixels"):
            load_image(tmp_path / "a.png")


def test_pillows_own_limit_neither_warns_nor_refuses(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((100, 110, 3), np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert image_size(tmp_path / "a.png") == (110, 100)
    assert Image.MAX_IMAGE_PIXELS == 1000


def upright(height: int = 48, width: int = 32) -> np.ndarray:
    return UPRIGHT.repeat(height // 3, axis=0).repeat(width // 2, axis=1)


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".avif"])
def test_size_and_pixels_are_turned_alike(tmp_path, suffix, orientation):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](upright())))
    stored.save(tmp_path / f"a{suffix}", exif=exif, **({} if suffix == ".png" else {"quality": 95}))
    assert image_size(tmp_path / f"a{suffix}") == (32, 48)
    pixels = load_image(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(pixels[8::16, 8::16].astype(int), UPRIGHT.astype(int), atol=12)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp", ".jp2", ".avif", ".ppm"])
def test_sizes_need_no_decoding_and_cut_files_are_damaged(tmp_path, suffix, monkeypatch):
    noise = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8), (0, 0), 2)
    content = cv2.imencode(suffix, noise)[1].tobytes()
    path = tmp_path / f"a{suffix}"
    for share in (0.5, 0.9):
        path.write_bytes(content[: int(len(content) * share)])
        with pytest.raises(DamagedImage, match=f"a{suffix}: is") as caught:
            load_image(path)
        assert caught.value.path == path and "\n" not in str(caught.value)
    path.write_bytes(content)
    monkeypatch.setattr(cv2, "imdecode", None)
    monkeypatch.setattr(Image.Image, "load", None)
    assert image_size(path) == (90, 60)


def test_what_is_no_image_has_no_size(tmp_path):
    (tmp_path / "text.jpg").write_text("not an image")
    Image.new("RGB", (4, 4)).save(tmp_path / "a.gif")
    (tmp_path / "a.gif").rename(tmp_path / "gif.png")
    for name in ("text.jpg", "gif.png", "absent.jpg", "."):
        with pytest.raises(DamagedImage, match=r"expected an image|not a supported image|is a folder"):
            image_size(tmp_path / name)


def test_a_header_that_does_not_fit_its_pixels_is_damage(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((6, 8, 3), np.uint8))
    monkeypatch.setattr(images.cv2, "imdecode", lambda content, flags: np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(DamagedImage, match=r"its header says 8 x 6 pixels, it has 80 x 60"):
        load_image(tmp_path / "a.png")


@given(at=st.integers(0, 400), replacement=st.binary(min_size=1, max_size=6), kind=st.sampled_from(range(5)))
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_headers_are_read_or_refused(tmp_path, at, replacement, kind, monkeypatch):
    monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", "1")
    name = ("PNG", "JPEG", "TIFF", "WEBP", "AVIF")[kind]
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    written = io.BytesIO()
    Image.fromarray(upright()).save(written, name, exif=exif)
    content = bytearray(written.getvalue())
    content[at : at + len(replacement)] = replacement
    (tmp_path / "mutated.png").write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            size = image_size(tmp_path / "mutated.png")
        except InputError as error:
            assert "mutated.png: " in str(error) and "\n" not in str(error)
            return
    assert size[0] * size[1] <= 10**6


def test_heic_is_read_upright(monkeypatch):
    assert image_size(HEIC) == (32, 48)
    np.testing.assert_allclose(load_image(HEIC)[8::16, 8::16].astype(int), UPRIGHT.astype(int), atol=12)
    assert exif_focal(HEIC, 36, 24) == pytest.approx(26)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    with pytest.raises(InputError, match=r"turned\.heic: is a HEIC image, for which pi-heif is needed; pip install"):
        load_image(HEIC)
