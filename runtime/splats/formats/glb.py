"""Gaussians as binary glTF (.glb) with the extension KHR_gaussian_splatting (Khronos, 2026), all in float32.

Scales and opacities are those of `Gaussians`, rotations xyzw, SH one attribute for each coefficient. The axes are
glTF's (x left, y up, z forward), a rotation by 180 degrees about z. COLOR_0 gives coloured points to viewers without
support for splats. Nothing is lost but the length of the quaternions, which are normalised.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, raise_input_error
from ...geometry.quaternions import normalize_quaternions
from ...images.colormaps import srgb_to_linear, to_uint8
from ...system.files import atomic_write, check_expansion, read_bytes
from ..axes import GLTF, convert_axes
from ..gaussians import Gaussians, bytes_in_memory, check_finite, check_ranges
from .ply_header import OFFSET, checked_offset

EXTENSION = "KHR_gaussian_splatting"
PREFIX = EXTENSION + ":"
HEADER = struct.Struct("<4sII")  # magic, version, length
CHUNK = struct.Struct("<I4s")  # length, type
MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"
EXPECTED = "a binary glTF file with splats (.glb)"

FLOATS, UNSIGNED_BYTE = {"componentType": 5126}, 5121
# Component types that the extension allows, and the largest value of normalised integers.
COMPONENTS = {5120: ("<i1", 127), 5121: ("<u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535), 5126: ("<f4", 1)}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
POINTS = 0
# Transformations of a node that are the identity.
IDENTITY_TRANSFORMS = {
    "matrix": np.eye(4).ravel().tolist(),
    "rotation": [0, 0, 0, 1],
    "scale": [1, 1, 1],
    "translation": [0, 0, 0],
}
ARRAY_BUFFER = 34962


def write_glb(path: Path, gaussians: Gaussians, offset: np.ndarray | None = None) -> list[str]:
    """Write Gaussians as a .glb; the file is replaced atomically.

    offset: what was subtracted from the world coordinates, [3], in the scene's own axes, which the extras of the node
    record: as its translation it would be rounded to float32.
    Returns no line, since nothing is lost. Raises InputError if a value is not finite or not in our units, or the file
    cannot be written.
    """
    check_ranges(path, gaussians)
    check_finite(path, gaussians)
    if not len(gaussians):
        raise InputError(f"cannot write {path}: there are no Gaussians, and glTF has no empty accessors; write a .ply")
    converted = convert_axes(gaussians, GLTF)
    attributes = {
        "POSITION": converted.means,
        "COLOR_0": to_uint8(np.column_stack([srgb_to_linear(converted.colours), converted.opacities])),
        PREFIX + "ROTATION": np.roll(normalize_quaternions(converted.quats), -1, axis=1),
        PREFIX + "SCALE": converted.scales,
        PREFIX + "OPACITY": converted.opacities,
    }
    names = _coefficients(converted.sh_degree)
    attributes |= {name: converted.sh[:, index] for index, name in enumerate(names)}
    content = _document(attributes)
    if offset is not None and offset.any():
        content["nodes"][0]["extras"] = {OFFSET: offset.tolist()}
    document = json.dumps(content, separators=(",", ":")).encode()
    document += b" " * (-len(document) % 4)
    size = sum(values.nbytes for values in attributes.values())
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(HEADER.pack(MAGIC, VERSION, HEADER.size + 2 * CHUNK.size + len(document) + size))
        file.write(CHUNK.pack(len(document), JSON) + document + CHUNK.pack(size, BINARY))
        for values in attributes.values():
            file.write(np.ascontiguousarray(values).data)
    return []


def read_glb(path: Path) -> Gaussians:
    """Read a .glb with one primitive of splats; raises InputError if it cannot be read, has none, or is damaged."""
    document, binary = _chunks(path, read_bytes(path, EXPECTED))
    try:
        gaussians = _read_gaussians(path, document, binary)
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise_input_error(path, f"invalid glTF ({type(error).__name__}: {str(error)[:60]})", "write it again")
    check_finite(path, gaussians)
    if (gaussians.scales < 0).any() or ((gaussians.opacities < 0) | (gaussians.opacities > 1)).any():
        raise_input_error(path, "negative scales, or opacities outside 0 to 1", "write it again")
    return convert_axes(gaussians, GLTF)


def glb_offset(path: Path) -> np.ndarray:
    """The offset that a .glb records as subtracted from its coordinates, in OpenCV's axes, float64 [3]; zeros if none.

    Raises InputError as `read_glb`.
    """
    document, _ = _chunks(path, read_bytes(path, EXPECTED))
    nodes = document.get("nodes")
    extras = [node.get("extras") for node in nodes if isinstance(node, dict)] if isinstance(nodes, list) else []
    found = [extra[OFFSET] for extra in extras if isinstance(extra, dict) and OFFSET in extra]
    return checked_offset(path, found[0]) if found else np.zeros(3)


def _read_gaussians(path: Path, document: dict[str, Any], binary: bytes) -> Gaussians:
    """The Gaussians in glTF's axes; raises InputError, or KeyError and the like where the JSON is invalid."""
    attributes = _splat_attributes(path, document)
    count = document["accessors"][attributes["POSITION"]]["count"]
    degree = max(d for d in range(4) if set(_coefficients(d)) <= set(attributes))

    def read(name: str, kind: str) -> np.ndarray:
        values = _read_accessor(path, document, binary, attributes[name], kind)
        if len(values) != count:
            raise_input_error(path, f"{len(values)} values of {name} for {count} splats", "write it again")
        return values

    means = read("POSITION", "VEC3")
    check_expansion(path, bytes_in_memory(count, degree), len(binary))  # accessors may share their bytes
    return Gaussians(
        means=means,
        scales=read(PREFIX + "SCALE", "VEC3"),
        quats=np.roll(read(PREFIX + "ROTATION", "VEC4"), 1, axis=1),
        opacities=read(PREFIX + "OPACITY", "SCALAR")[:, 0],
        sh=np.stack([read(name, "VEC3") for name in _coefficients(degree)], axis=1),
    )


def _coefficients(degree: int) -> list[str]:
    """Attribute names of the SH coefficients up to a degree, in the order of `Gaussians.sh`."""
    return [f"{PREFIX}SH_DEGREE_{d}_COEF_{index}" for d in range(degree + 1) for index in range(2 * d + 1)]


def _document(attributes: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON document that describes the arrays, which follow each other in the buffer."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for values in attributes.values():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": ARRAY_BUFFER})
        offset += values.nbytes
        width = values.shape[1] if values.ndim == 2 else 1
        kind = next(name for name, parts in WIDTHS.items() if parts == width)
        number = {"componentType": UNSIGNED_BYTE, "normalized": True} if values.dtype == np.uint8 else FLOATS
        accessors.append({"bufferView": len(accessors), "count": len(values), "type": kind, **number})
    positions = attributes["POSITION"]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {EXTENSION: splats},
    }
    return {
        "asset": {"version": "2.0", "generator": "idesplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _chunks(path: Path, content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk."""
    if not content.startswith(MAGIC):
        raise_input_error(path, "not a .glb file (it does not begin with 'glTF')", f"expected {EXPECTED}")
    if len(content) < HEADER.size + CHUNK.size or HEADER.unpack_from(content)[2] > len(content):
        raise_input_error(path, "cut short", "copy or download it again")
    chunks: dict[bytes, bytes] = {}
    offset = HEADER.size
    while offset + CHUNK.size <= len(content):
        length, kind = CHUNK.unpack_from(content, offset)
        offset += CHUNK.size
        chunks.setdefault(kind, content[offset : offset + length])
        offset += length
    try:
        document = json.loads(chunks.get(JSON, b""))
    except (ValueError, RecursionError):
        raise_input_error(path, "its JSON cannot be read", "copy or download it again")
    if not isinstance(document, dict):
        raise_input_error(path, "its JSON is not glTF", "write it again")
    return document, chunks.get(BINARY, b"")


def _splat_attributes(path: Path, document: dict[str, Any]) -> dict[str, int]:
    """The accessor index of each attribute of the one primitive with splats."""
    primitives = [part for mesh in document.get("meshes", []) for part in mesh["primitives"]]
    splats = [part for part in primitives if EXTENSION in part.get("extensions", {})]
    if len(splats) != 1:
        what = f"{len(splats)} primitives of splats ({EXTENSION})"
        raise_input_error(path, what, "expected one; a mesh or point cloud holds no Gaussians")
    if splats[0]["extensions"][EXTENSION].get("extensions"):
        raise_input_error(path, "the splats are compressed by a further extension", "write it without")
    for node in document.get("nodes", []):
        if any(node.get(name, still) != still for name, still in IDENTITY_TRANSFORMS.items()):
            raise_input_error(path, "a node transforms the splats", "write it with the transformation applied")
    attributes = splats[0]["attributes"]
    needed = ["POSITION", PREFIX + "ROTATION", PREFIX + "SCALE", PREFIX + "OPACITY", *_coefficients(0)]
    missing = [name for name in needed if name not in attributes]
    if missing:
        raise_input_error(path, f"the splats have no {', '.join(missing)}", "write it again")
    return attributes


def _read_accessor(path: Path, document: dict[str, Any], binary: bytes, index: int, kind: str) -> np.ndarray:
    """One array of the document as float32 [count, components]."""
    accessor = document["accessors"][index]
    if accessor["type"] != kind or "sparse" in accessor:
        raise_input_error(path, f"accessor {index} is {accessor['type']}", f"expected {kind} without sparse values")
    view = document["bufferViews"][accessor["bufferView"]]
    if view["buffer"] != 0 or "uri" in document["buffers"][0]:
        raise_input_error(path, f"accessor {index} lies outside the file", "write all in one .glb")
    name, highest = COMPONENTS[accessor["componentType"]]
    number, parts = np.dtype(name), WIDTHS[kind]
    stride = view.get("byteStride", number.itemsize * parts)
    start, count = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), accessor["count"]
    end = start + (count - 1) * stride + number.itemsize * parts
    if min(start, count - 1, stride - number.itemsize * parts, len(binary) - end) < 0:
        raise_input_error(
            path, f"cut short: accessor {index} needs {end} bytes of {len(binary)}", "copy or download it again"
        )
    values = np.ndarray((count, parts), number, binary, start, (stride, number.itemsize)).astype(np.float32)
    return np.maximum(values / highest, -1) if accessor.get("normalized") else values
