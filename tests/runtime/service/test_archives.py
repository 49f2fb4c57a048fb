"""Uploaded zips: what is unpacked, and whatever else a zip may hold."""

import io
import tempfile
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from idesplat.runtime.errors import InputError
from idesplat.runtime.service.archives import safe_name, unpack
from idesplat.runtime.service.limits import Limits, Refused
from mutations import TEXTS, mutated, tried

LIMITS = Limits(upload_bytes=1 << 16, images=4)


def zipped(entries: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


GOOD = {"room/images/a.png": b"a" * 100, "room/images/b.PNG": b"b" * 1000, "room/sparse/0/cameras.bin": bytes(50)}


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_images_and_cameras_are_unpacked_and_nothing_else(tmp_path):
    others = {"room/.hidden.png": b"", "__MACOSX/room/images/._a.png": b"", "room/read.me": b"", "room/run.sh": b""}
    unpack(io.BytesIO(zipped(GOOD | others)), tmp_path / "out", LIMITS)
    assert files_in(tmp_path) == {f"out/{name}": content for name, content in GOOD.items()}


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unusual_compressions_are_refused(tmp_path, compression):
    with pytest.raises(InputError, match="unusual"):
        unpack(io.BytesIO(zipped(GOOD, compression)), tmp_path / "out", LIMITS)


def test_what_comes_out_is_counted(tmp_path):
    with pytest.raises(Refused) as refused:
        unpack(io.BytesIO(zipped({"a.png": bytes(1 << 15), "b.png": bytes(1 << 15), "c.png": b"1"})), tmp_path, LIMITS)
    assert refused.value.status == 413
    assert sum(map(len, files_in(tmp_path).values())) <= LIMITS.upload_bytes


@tried(40)
@given(data=st.data())
def test_any_zip_is_unpacked_within_its_folder_or_refused(data):
    names = data.draw(
        st.lists(st.sampled_from([text for text in TEXTS if text.isprintable()]), max_size=3, unique=True)
    )
    content = zipped(GOOD | {f"{name}.png": b"x" for name in names}, data.draw(st.sampled_from([0, 8])))
    content = data.draw(mutated(content)) if data.draw(st.booleans()) else content
    with tempfile.TemporaryDirectory() as folder:
        try:
            unpack(io.BytesIO(content), Path(folder, "out"), LIMITS)
        except (InputError, Refused) as error:
            assert len(str(error)) < 1000
        found = files_in(Path(folder))
        assert all(name.startswith("out/") for name in found)
        assert sum(map(len, found.values())) <= LIMITS.upload_bytes


@pytest.mark.parametrize("name", ["a.png", "../a.png", "C:\\images\\a.png", "/etc/a.png"])
def test_names_lose_their_folders(name):
    assert safe_name(name) == "a.png"


@pytest.mark.parametrize("name", ["", ".", "..", "a/..", "a\x00.png", "a\n.png", "a:b.png", "a?.png", "a. ", "x" * 201])
def test_names_that_not_every_system_stores_are_refused(name):
    with pytest.raises(InputError, match="not a usable file name"):
        safe_name(name)
