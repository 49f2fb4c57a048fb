"""The metadata properties of an .onnx file, read without loading the graph.

An .onnx file is one protobuf message, `ModelProto` of onnx.proto3: a sequence of fields, each a key (the varint
field number << 3 | wire type) and a value. Only `metadata_props` is read. The other fields, among them the graph of
perhaps hundreds of megabytes, are skipped by seeking. The file is not trusted: every length is checked against the
end of the message that holds it.
"""

import os
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from ..errors import raise_input_error
from ..system.files import open_regular

METADATA_PROPS = 14  # of ModelProto: repeated StringStringEntryProto
KEY, VALUE = 1, 2  # of StringStringEntryProto
VARINT, BYTES = 0, 2  # wire types
FIXED_LENGTHS = {1: 8, 5: 4}  # of the other wire types; 3 and 4 are groups, which ONNX does not use
VARINT_BYTES = 10  # that 64 bits take at most
MAX_FIELDS = 1 << 16  # of a model: it has one graph, a few operator sets, and as many functions and properties
MAX_PROPERTY_BYTES = 1 << 23


def read_properties(path: Path) -> dict[str, str]:
    """The metadata properties of an .onnx file by name; of a name that occurs twice, the last, as ONNX Runtime has it.

    Raises InputError if the file cannot be read or is no protobuf message.
    """
    properties = {}
    try:
        with open_regular(path) as file:
            for number, kind, length in _fields(file, os.fstat(file.fileno()).st_size):
                if number == METADATA_PROPS and kind == BYTES:
                    if length > MAX_PROPERTY_BYTES:
                        raise ValueError(f"a metadata property of {length} bytes")
                    name, value = _entry(file.read(length))
                    properties[name] = value
    except OSError as error:
        raise_input_error(path, f"cannot be read ({error.strerror})", "expected a .onnx file")
    except UnicodeDecodeError:
        raise_input_error(path, "damaged: its metadata is not UTF-8", "export it again")
    except ValueError as error:
        raise_input_error(path, f"no ONNX model, or damaged ({error})", "expected a .onnx file made by idesplat export")
    return properties


def _entry(content: bytes) -> tuple[str, str]:
    """Name and value of one property."""
    found = {KEY: "", VALUE: ""}
    file = BytesIO(content)
    for number, kind, length in _fields(file, len(content)):
        if number in found and kind == BYTES:
            found[number] = file.read(length).decode()
    return found[KEY], found[VALUE]


def _fields(file: BinaryIO, end: int) -> Iterator[tuple[int, int, int]]:
    """Field number, wire type and length of each value up to the byte `end`; the file stands where the value begins.

    A varint, whose value ONNX's metadata does not need, is passed over and has length 0.
    Raises ValueError where the bytes are no sequence of fields.
    """
    for _ in range(MAX_FIELDS):
        if file.tell() >= end:
            return
        key = _varint(file)
        number, kind = key >> 3, key & 7
        length = FIXED_LENGTHS.get(kind, 0)
        if kind == VARINT:
            _varint(file)
        elif kind == BYTES:
            length = _varint(file)
        elif kind not in FIXED_LENGTHS:
            raise ValueError(f"a field of wire type {kind}")
        start = file.tell()
        if number == 0 or length > end - start:
            raise ValueError(f"a field of {length} bytes at byte {start} of {end}")
        yield number, kind, length
        file.seek(start + length)
    raise ValueError(f"more than {MAX_FIELDS} fields")


def _varint(file: BinaryIO) -> int:
    """An unsigned integer, seven bits a byte, the lowest first; the highest bit of a byte says that more follow."""
    value = 0
    for index in range(VARINT_BYTES):
        byte = file.read(1)
        if not byte:
            raise ValueError("cut short")
        value |= (byte[0] & 0x7F) << 7 * index
        if byte[0] < 0x80:
            return value
    raise ValueError("a number of more than 64 bits")
