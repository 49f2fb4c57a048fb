"""Metadata properties read from the bytes of an .onnx file, against what the onnx package and ONNX Runtime read."""

from pathlib import Path

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from idesplat import InputError
from idesplat.runtime.inference import predictor as predictor_module
from idesplat.runtime.inference.metadata import METADATA_KEY
from idesplat.runtime.inference.model_files import read_model
from idesplat.runtime.inference.onnx_metadata import MAX_FIELDS, MAX_PROPERTY_BYTES, read_properties
from idesplat.runtime.inference.session import open_session
from onnx import helper
from tiny_model import OWN, write_model


@settings(max_examples=100, deadline=None)
@given(properties=st.dictionaries(st.text(max_size=300), st.text(max_size=300), max_size=4))
def test_properties_are_those_of_the_onnx_package(
    tmp_path_factory: pytest.TempPathFactory, properties: dict[str, str]
) -> None:
    path = write_model(tmp_path_factory.mktemp("model") / "model.onnx")
    model = onnx.load(path)
    del model.metadata_props[:]
    helper.set_model_props(model, properties)
    path.write_bytes(model.SerializeToString())
    assert read_properties(path) == properties


def test_the_last_of_two_properties_of_a_name_counts_as_in_onnx_runtime(tmp_path: Path) -> None:
    path = write_model(tmp_path / "model.onnx")
    for value in ("first", "second"):
        entry = onnx.StringStringEntryProto(key="twice", value=value).SerializeToString()
        path.write_bytes(path.read_bytes() + bytes([14 << 3 | 2, len(entry)]) + entry)
    expected = open_session(path).get_modelmeta().custom_metadata_map
    assert read_properties(path) == expected
    assert expected["twice"] == "second"


def test_a_model_is_described_without_loading_its_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor_module, "open_session", None)
    model = read_model(write_model(tmp_path / "model.onnx"))
    assert model.metadata == OWN
    assert [stage.name for stage in model.stages] == ["model"]


def test_large_fields_are_skipped(tmp_path: Path) -> None:
    """A graph of 1 GiB of zeros, which is not on the disk, and the metadata behind it."""
    length, properties = 1 << 30, write_model(tmp_path / "model.onnx").read_bytes()
    path = tmp_path / "large.onnx"
    with path.open("wb") as file:
        file.write(bytes([7 << 3 | 2, 0x80, 0x80, 0x80, 0x80, 0x04]))
        file.seek(length, 1)
        file.write(properties)
    assert METADATA_KEY in read_properties(path)


def field(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2]) + len(content).to_bytes(1, "little") + content


DAMAGED = {
    "text": (b"hello", "wire type 4"),
    "a length beyond the end": (b"\x3a\x7fabc", "a field of 127 bytes"),
    "a length beyond every file": (b"\x3a" + b"\xff" * 9 + b"\x01", "a field of 18446744073709551615 bytes"),
    "a varint without end": (b"\x08" + b"\x80" * 20, "more than 64 bits"),
    "a varint cut short": (b"\x08\x80", "cut short"),
    "a fixed value cut short": (b"\x09abc", "a field of 8 bytes"),
    "field number zero": (b"\x00\x01", "a field of"),
    "many fields": (b"\x08\x01" * (MAX_FIELDS + 1), f"more than {MAX_FIELDS} fields"),
    "a large property": (b"\x72\x81\x80\x80\x04" + bytes((1 << 23) + 1), f"{MAX_PROPERTY_BYTES + 1} bytes"),
    "a property cut short": (field(14, b"\x0a\x05abc"), "a field of 5 bytes"),
    "a property that is not UTF-8": (field(14, b"\x0a\x02\xff\xfe"), "not UTF-8"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_refused(tmp_path: Path, name: str) -> None:
    content, expected = DAMAGED[name]
    path = tmp_path / "model.onnx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"model\.onnx: .*{expected}") as error:
        read_properties(path)
    assert "\n" not in str(error.value)


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = write_model(tmp_path_factory.mktemp("model") / "model.onnx")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        found = read_properties(path)
    except InputError as error:
        assert "model.onnx: " in str(error) and "\n" not in str(error)
        return
    assert all(type(text) is str for pair in found.items() for text in pair)
