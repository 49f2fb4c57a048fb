"""Splat files that are cut, mixed up, bombs, or not what their name says: one line each, and no harm done."""

import json
import struct
import sys
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import FORMATS, read_splats, write_splats
from splat_cases import (
    ARRAYS,
    DATA,
    glb,
    gzipped,
    load_truth,
    spz_header,
)


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return load_truth()


VERSION_4 = "scene.v4.spz"  # which others write, and we read


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, truth: Gaussians) -> dict[str, bytes]:
    """A small file of every format."""
    folder = tmp_path_factory.mktemp("written")
    small = Gaussians(*(getattr(truth, name)[:5] for name in ARRAYS))
    for suffix in FORMATS:
        write_splats(folder / f"scene{suffix}", small)
    files = {suffix: (folder / f"scene{suffix}").read_bytes() for suffix in FORMATS}
    return files | {VERSION_4: (DATA / VERSION_4).read_bytes()}


def read_or_refuse(path: Path) -> Gaussians | None:
    """What a reader makes of a file, once its warnings are errors and its refusal is one line with the file's name."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            gaussians = read_splats(path)
        except InputError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
            return None
    for name in ARRAYS:
        assert np.isfinite(getattr(gaussians, name)).all()
    assert (gaussians.scales >= 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    return gaussians


@pytest.mark.parametrize("suffix", [*FORMATS, VERSION_4])
def test_truncations_are_refused(tmp_path: Path, written: dict[str, bytes], suffix: str) -> None:
    path = tmp_path / f"cut{suffix}"
    content = written[suffix]
    for length in [*range(0, len(content), 17), *range(len(content) - 40, len(content))]:
        path.write_bytes(content[:length])
        whole = suffix == ".splat" and length % 32 == 0 and length  # nothing says that there were more
        assert (read_or_refuse(path) is not None) == bool(whole), length


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    "content", [b"", b"\x00" * 1000, b"\xff" * 999, b"ply\n", b"\x1f\x8b\x08", b"PK\x03\x04", b"glTF"]
)
def test_files_of_another_type_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"wrong{suffix}"
    path.write_bytes(content)
    assert read_or_refuse(path) is None


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("field", ["means", "scales", "quats", "opacities", "sh"])
def test_values_that_are_not_numbers_are_not_written(tmp_path: Path, truth: Gaussians, suffix: str, field: str) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(b"an earlier result")
    broken = Gaussians(*(getattr(truth, name).copy() for name in ARRAYS))
    getattr(broken, field)[17, ...] = np.nan
    with pytest.raises(InputError, match=r"Gaussian 17 is not"):
        write_splats(path, broken)
    assert path.read_bytes() == b"an earlier result"
    assert list(tmp_path.iterdir()) == [path]


BROKEN_SPZ = {
    "version 1": (gzipped(spz_header(version=1)), "version 1; expected version 2 to 4"),
    "version 5": (spz_header(version=5), "version 5; expected version 2 to 4"),
    "version 4 in gzip": (gzipped(spz_header(version=4)), "version 4; expected"),
    "version 4, cut": (spz_header(version=4, count=1), "0 streams with their contents at byte 0; expected 5"),
    "version 4, far too many": (spz_header(version=4, count=1 << 31), "claim to hold 42949672960 are no scene"),
    "other magic": (gzipped(spz_header(magic=b"GSPN")), "gzip stream of something else"),
    "short header": (gzipped(spz_header()[:10]), "cut short in its header"),
    "degree 4": (gzipped(spz_header(degree=4)), "SH degree 4; expected 0 to 3"),
    "bits": (gzipped(spz_header(bits=60)), "60 fractional bits"),
    "extensions": (gzipped(spz_header(flags=2)), "has extensions"),
    "too few": (gzipped(spz_header(count=3) + b"\x00" * 59), "cut short: 3 Gaussians need 60 bytes"),
    "far too many": (gzipped(spz_header(count=1 << 31)), "claim to hold 42949672960 are no scene"),
    "checksum": (gzipped(spz_header(count=3) + b"\x00" * 60)[:-8] + b"\x00" * 8, "damaged"),
}


@pytest.mark.parametrize("name", BROKEN_SPZ)
def test_broken_spz_files_are_named(tmp_path: Path, name: str) -> None:
    content, message = BROKEN_SPZ[name]
    path = tmp_path / "broken.spz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_splats(path)


def zstd_spz(count: int, unpacked: int) -> bytes:
    """A .spz of version 4 whose five streams hold zeros, as many as are said, whatever the table of contents says."""
    header = spz_header(count, version=4)[:-1] + bytes([5])
    stream = zstandard.ZstdCompressor().compress(bytes(unpacked))
    table = b"".join(np.array([len(stream), count * size], "<u8").tobytes() for size in (9, 1, 3, 3, 4))
    return header + np.array([32, 0, 0, 0], "<u4").tobytes() + table + 5 * stream


def test_a_zstd_bomb_does_not_go_off(tmp_path: Path) -> None:
    """Streams that hold far more than they say are read as far as they say."""
    path = tmp_path / "bomb.spz"
    path.write_bytes(zstd_spz(3, 300_000_000))
    tracemalloc.start()
    assert len(read_splats(path)) == 3
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20_000_000
    path.write_bytes(zstd_spz(3, 26))
    with pytest.raises(InputError, match="cut short: stream 0 needs 27 bytes"):
        read_splats(path)
    damaged = bytearray(zstd_spz(3, 27))
    damaged[32 + 5 * 16 : 32 + 5 * 16 + 4] = b"none"
    path.write_bytes(damaged)
    with pytest.raises(InputError, match="stream 0 is damaged"):
        read_splats(path)


def test_without_zstandard_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(InputError, match=r'v4.spz: .spz of version 4 .*; pip install "idesplat\[spz\]"'):
        read_splats(DATA / VERSION_4)


def test_a_bomb_does_not_go_off(tmp_path: Path) -> None:
    """A stream of zeros, 200 MB long in .2 MB, that its header calls a scene: refused before it is unpacked."""
    count = 10_000_000
    compressor = zlib.compressobj(wbits=31)
    content = compressor.compress(spz_header(count))
    zeros = bytes(20_000_000)
    content += b"".join(compressor.compress(zeros) for _ in range(10)) + compressor.flush()
    path = tmp_path / "bomb.spz"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match="claim to hold 200000000 are no scene"):
        read_splats(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * len(content) + 1e6


def opened(suffix: str, content: bytes) -> dict[str, bytes]:
    """What lies inside a compressed file: there, mutations get farther than to the packing."""
    if suffix == ".spz":
        return {"": zlib.decompress(content, wbits=31)}
    if suffix == ".sog":
        with zipfile.ZipFile(BytesIO(content)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    return {}


def closed(suffix: str, parts: dict[str, bytes]) -> bytes:
    if suffix == ".spz":
        return gzipped(parts[""])
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return packed.getvalue()


def sog(content: bytes, change: Callable[[dict[str, bytes], dict], None]) -> bytes:
    """A .sog whose files and meta.json something was done to."""
    files = opened(".sog", content)
    meta = json.loads(files.pop("meta.json"))
    change(files, meta)
    return closed(".sog", {**files, "meta.json": json.dumps(meta).encode()})


def webp(shape: tuple[int, ...], quality: int = 101) -> bytes:
    return cv2.imencode(".webp", np.full(shape, 77, np.uint8), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()


BROKEN_SOG = {
    "version 1": (lambda files, meta: meta.update(version=1), "version 1; expected 2"),
    "no version": (lambda files, meta: meta.pop("version"), "KeyError: 'version'"),
    "no count": (lambda files, meta: meta.update(count="5"), "count is 5"),
    "far too many": (lambda files, meta: meta.update(count=10**12), r"claim to hold \d{14,} are no scene"),
    "more than there are": (lambda files, meta: meta.update(count=17), "has 4x4 pixels for 17 values"),
    "image missing": (lambda files, meta: files.pop("quats.webp"), "quats.webp"),
    "image of 268 million pixels": (
        lambda files, meta: files.update({"scales.webp": webp((16, 16, 3))[:21] + b"\xff" * 4 + b"\0" * 99}),
        "16384x16384 pixels for 5 values",
    ),
    "lossy": (lambda files, meta: files.update({"scales.webp": webp((4, 4, 3), 80)}), "not a lossless WebP"),
    "not an image": (lambda files, meta: files.update({"scales.webp": b"RIFF" * 20}), "not a lossless WebP"),
    "without alpha": (lambda files, meta: files.update({"quats.webp": webp((4, 4, 3))}), "quats has no alpha"),
    "no largest component": (lambda files, meta: files.update({"quats.webp": webp((4, 4, 4))}), "largest component"),
    "short codebook": (lambda files, meta: meta["sh0"]["codebook"].pop(), r"sh0.codebook has shape \(255,\)"),
    "words in a codebook": (lambda files, meta: meta["sh0"].update(codebook=["x"] * 256), "ValueError"),
    "NaN": (lambda files, meta: meta["scales"].update(codebook=[float("nan")] * 256), "scales of Gaussian 0 is not"),
    "an infinite end": (
        lambda files, meta: meta["means"].update(mins=[float("-inf")] * 3),
        "means of Gaussian 0 is not",
    ),
    "degree 7": (lambda files, meta: meta["shN"].update(bands=7), "SH of degree 7"),
    "sets that are not there": (
        lambda files, meta: files.update({"shN_labels.webp": webp((4, 4, 3))}),
        f"centroid {77 * 257} of 5",
    ),
}


@pytest.mark.parametrize("name", BROKEN_SOG)
def test_broken_sog_files_are_named(tmp_path: Path, written: dict[str, bytes], name: str) -> None:
    change, message = BROKEN_SOG[name]
    path = tmp_path / "broken.sog"
    path.write_bytes(sog(written[".sog"], change))
    with warnings.catch_warnings(), pytest.raises(InputError, match=message) as caught:
        warnings.simplefilter("error")
        read_splats(path)
    assert str(path) in str(caught.value)


def test_a_bomb_in_an_archive_does_not_go_off(tmp_path: Path, written: dict[str, bytes]) -> None:
    path = tmp_path / "bomb.sog"
    path.write_bytes(written[".sog"])
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("more.webp", bytes(90_000_000))
    with pytest.raises(InputError, match=r"bomb.sog: \d+ bytes that claim to hold 900\d+ are no scene"):
        read_splats(path)


def test_an_image_of_one_colour_is_no_scene(tmp_path: Path, written: dict[str, bytes]) -> None:
    """A million Gaussians, 236 MB in memory, in a few kB."""

    def blow_up(files: dict[str, bytes], meta: dict) -> None:
        meta["count"] = 1_000_000
        flat = np.zeros((1000, 1000, 4), np.uint8)
        flat[..., 3] = 255
        content = cv2.imencode(".webp", flat, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
        opaque = cv2.imencode(".webp", flat[..., :3], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
        for name in files:
            if name != "shN_centroids.webp":
                files[name] = content if name in ("quats.webp", "sh0.webp") else opaque

    path = tmp_path / "flat.sog"
    path.write_bytes(sog(written[".sog"], blow_up))
    assert path.stat().st_size < 60_000
    with pytest.raises(InputError, match=r"flat.sog: \d+ bytes that claim to hold \d+ .*IDESPLAT_MAX_EXPANSION"):
        read_splats(path)


def test_a_directory_that_lies_of_sizes_does_not_fill_memory(tmp_path: Path, written: dict[str, bytes]) -> None:
    """Only as many bytes are unpacked as the archive's directory says."""
    files = opened(".sog", written[".sog"])
    size = len(files["quats.webp"])
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, bytes(90_000_000) if name == "quats.webp" else content)
    content = packed.getvalue().replace(struct.pack("<I", 90_000_000), struct.pack("<I", size))
    path = tmp_path / "lie.sog"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"lie\.sog"):
        read_splats(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30e6


def primitive(document: dict) -> dict:
    return document["meshes"][0]["primitives"][0]


BROKEN_GLB = {
    "a mesh": (lambda d: primitive(d).pop("extensions"), "0 primitives of splats"),
    "two primitives": (lambda d: d["meshes"].append(d["meshes"][0]), "2 primitives of splats"),
    "compressed": (
        lambda d: primitive(d)["extensions"]["KHR_gaussian_splatting"].update(extensions={"spz": {}}),
        "compressed by a further extension",
    ),
    "moved": (lambda d: d["nodes"][0].update(translation=[0, 0, 1]), "a node transforms"),
    "no opacity": (
        lambda d: primitive(d)["attributes"].pop("KHR_gaussian_splatting:OPACITY"),
        "no KHR_gaussian_splatting:OPACITY",
    ),
    "sparse": (lambda d: d["accessors"][0].update(sparse={}), "without sparse values"),
    "wrong kind": (lambda d: d["accessors"][0].update(type="SCALAR"), "accessor 0 is SCALAR; expected VEC3"),
    "elsewhere": (lambda d: d["buffers"][0].update(uri="other.bin"), "lies outside the file"),
    "beyond the end": (lambda d: d["accessors"][0].update(count=10**9), "cut short: accessor 0"),
    "before the beginning": (lambda d: d["bufferViews"][0].update(byteOffset=-4), "cut short: accessor 0"),
    "fewer": (lambda d: d["accessors"][2].update(count=4), "4 values of KHR_gaussian_splatting:ROTATION for 5 splats"),
    "no accessors": (lambda d: d.pop("accessors"), "invalid glTF .KeyError"),
    "a list for a number": (lambda d: d["accessors"][0].update(count=[]), "TypeError"),
}


@pytest.mark.parametrize("name", BROKEN_GLB)
def test_broken_glb_files_are_named(tmp_path: Path, written: dict[str, bytes], name: str) -> None:
    change, message = BROKEN_GLB[name]
    path = tmp_path / "broken.glb"
    path.write_bytes(glb(written[".glb"], change))
    with pytest.raises(InputError, match=message) as caught:
        read_splats(path)
    assert str(path) in str(caught.value)


SNIPPETS = [b"9", b"-", b"null", b"[", b"{}", b"1e999", b"NaN", b'"x"', b"\xff\xff\xff\xff", b"\0\0\0\0"]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", [*FORMATS, VERSION_4])
@given(data=st.data())
def test_any_mutation_gives_a_scene_or_an_input_error(
    tmp_path: Path, written: dict[str, bytes], suffix: str, data: st.DataObject
) -> None:
    parts = opened(suffix, written[suffix])
    inside = data.draw(st.sampled_from(sorted(parts))) if parts and data.draw(st.booleans()) else None
    content = bytearray(written[suffix] if inside is None else parts[inside])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        new = data.draw(st.binary(max_size=12) | st.sampled_from(SNIPPETS))
        content[at : at + data.draw(st.just(len(new)) | st.integers(0, 12))] = new
    path = tmp_path / f"mutated{suffix}"
    path.write_bytes(content if inside is None else closed(suffix, parts | {inside: bytes(content)}))
    read_or_refuse(path)
