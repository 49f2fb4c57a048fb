"""Headers of .ply files, for every layout of Gaussians in them."""

from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ...errors import InputError, raise_input_error
from ...system.files import open_regular

MAX_HEADER_BYTES = 1 << 20
MAGIC = b"ply"
NUMBER_TYPES = {
    "char": "<i1",
    "int8": "<i1",
    "uchar": "<u1",
    "uint8": "<u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
OFFSET = "offset"  # a comment with three numbers: what was subtracted from the world coordinates
LIST = "list"  # the type of a property of variable length


class Element(NamedTuple):
    """One element of a .ply header."""

    name: str
    length: int
    properties: dict[str, str]  # name -> NumPy type, or LIST

    @property
    def row(self) -> np.dtype:
        """The NumPy type of a row of an element without lists."""
        return np.dtype(list(self.properties.items()))


def read_header(file: BinaryIO, path: Path) -> tuple[list[Element], int]:
    """The elements of a binary little endian .ply header, and the header's length in bytes.

    Raises InputError, naming the path, if the file does not begin with such a header.
    """
    if file.readline(8).rstrip() != MAGIC:
        raise_input_error(
            path, "not a .ply file (it does not begin with the line 'ply')", "give a 3D Gaussian splatting .ply"
        )
    elements: list[Element] = []
    has_format = False
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        if not line.endswith(b"\n"):
            break
        match line.decode("ascii", errors="replace").split():
            case ["format", "binary_little_endian", "1.0"]:
                has_format = True
            case ["format", *form]:
                raise_input_error(
                    path, f"format {' '.join(form)}", "expected binary_little_endian 1.0; convert the file to that"
                )
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append(Element(name, int(count), {}))
            case ["property", kind, name] if elements and kind in NUMBER_TYPES:
                _add_property(elements[-1], name, NUMBER_TYPES[kind], path)
            case ["property", "list", _, _, name] if elements:
                _add_property(elements[-1], name, LIST, path)
            case ["end_header"] if has_format:
                return elements, file.tell()
            case ["comment" | "obj_info", *_] | []:
                pass
            case words:
                raise_input_error(
                    path, f"header line '{' '.join(words)[:60]}' is not understood", "write the file again"
                )
    raise_input_error(path, "the header has no end", "copy or download it again")


def _add_property(element: Element, name: str, number_type: str, path: Path) -> None:
    if name in element.properties:
        raise_input_error(path, f"element {element.name} has property {name} twice", "write it once")
    element.properties[name] = number_type


def has_element(path: Path, name: str) -> bool:
    """Whether a file's header has this element; raises InputError if it is no .ply that can be read."""
    try:
        with open_regular(path) as file:
            return any(element.name == name for element in read_header(file, path)[0])
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; expected a splat file (.ply)") from None


def offset_comment(offset: np.ndarray) -> str:
    """The header line that records an offset [3]; empty for zeros."""
    return f"comment {OFFSET} {' '.join(map(repr, offset.tolist()))}\n" if offset.any() else ""


def header_offset(path: Path) -> np.ndarray:
    """The offset that a file's header records as subtracted from its coordinates, float64 [3]; zeros if none.

    Raises InputError if the file cannot be read, or the offset is not three finite numbers.
    """
    try:
        with open_regular(Path(path)) as file:
            while file.tell() < MAX_HEADER_BYTES:
                line = file.readline(MAX_HEADER_BYTES)
                words = line.decode("ascii", errors="replace").split()
                if words[:2] == ["comment", OFFSET] and len(words) == 5:
                    return checked_offset(path, words[2:])
                if not line or words == ["end_header"]:
                    break
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; expected a splat file (.ply)") from None
    return np.zeros(3)


def checked_offset(path: Path, values: object) -> np.ndarray:
    """An offset read from a file as float64 [3]; raises InputError unless it is three finite numbers."""
    try:
        offset = np.array(values, np.float64)
    except (TypeError, ValueError):
        offset = np.zeros(0)
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise_input_error(
            path, f"records the offset {str(values)[:60]}", "expected three finite numbers; write it again"
        )
    return offset
