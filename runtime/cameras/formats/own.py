"""This project's own JSON format: one object for each camera, in the conventions of `Camera`.

{"format": "idesplat-cameras", "version": 1, "cameras": [
  {"image": "images/0001.jpg", "width": 1080, "height": 1920,
   "fx": 1375.5, "fy": 1374.5, "cx": 554.6, "cy": 965.3,     pixels, pixel centres at 0.5
   "distortion": [k1, k2, p1, p2],                           in OpenCV's order; null or absent for a pinhole camera
   "fisheye": true,                                          distortion is [k1, k2, k3, k4] of cv2.fisheye; or absent
   "depth_range": [1.5, 20.0],                               near and far depth of what is visible; absent if unknown
   "extrinsics": [[...], [...], [...], [0, 0, 0, 1]]}]}      camera-to-world, OpenCV axes
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...errors import InputError, error_context
from ...geometry.intrinsics import intrinsic_matrix
from ...system.files import atomic_write
from ..camera import Camera
from ..parsing import entries, finite, image_name, number, pixels, pose, read_json, short_repr
from ..source import CameraSource

DESCRIPTION = 'this project\'s JSON ("format": "idesplat-cameras")'
FORMAT = "idesplat-cameras"
VERSION = 1


def detect(source: CameraSource) -> bool:
    """Whether a JSON file has this format's name in its field `format`."""
    return source.document.get("format") == FORMAT


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file; `images` are not used. Raises InputError."""
    document = read_json(path)
    if document.get("format") != FORMAT:
        raise InputError(f'format is {short_repr(document.get("format"))}, expected "{FORMAT}"')
    if document.get("version") != VERSION:
        raise InputError(f"version is {short_repr(document.get('version'))}, expected {VERSION}; update idesplat")
    cameras = []
    for index, entry in enumerate(entries(document, "cameras")):
        with error_context(f"cameras[{index}]"):
            name = image_name(entry, "image")
        with error_context(f"cameras[{index}] ({name})"):
            cameras.append(_camera(entry, name))
    return cameras


def write(path: Path, cameras: Sequence[Camera]) -> None:
    """Write the file, which `read` reads back exactly. Raises InputError if the folder is not writable."""
    lines = ",\n".join(json.dumps(_entry(camera)) for camera in cameras)
    with atomic_write(path) as temporary:
        temporary.write_text(f'{{"format": "{FORMAT}", "version": {VERSION}, "cameras": [\n{lines}\n]}}\n')


def _camera(entry: dict[str, Any], name: str) -> Camera:
    fisheye = entry.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise InputError(f"fisheye is {short_repr(fisheye)}, expected true or false")
    return Camera(
        name,
        pixels(entry, "width"),
        pixels(entry, "height"),
        intrinsic_matrix(*(number(entry, field) for field in ("fx", "fy", "cx", "cy"))),
        pose(entry, "extrinsics"),
        _numbers(entry, "distortion"),
        fisheye,
        _numbers(entry, "depth_range"),  # type: ignore[arg-type] # Camera checks that there are two
    )


def _numbers(entry: dict[str, Any], field: str) -> tuple[float, ...] | None:
    values = entry.get(field)
    if values is None:
        return None
    if not isinstance(values, list):
        raise InputError(f"{field} is {short_repr(values)}, expected null or a list of numbers")
    return tuple(finite(value, field) for value in values)


def _entry(camera: Camera) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "image": camera.name,
        "width": camera.width,
        "height": camera.height,
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "distortion": None if camera.distortion is None else list(camera.distortion),
    }
    if camera.fisheye:
        entry["fisheye"] = True
    if camera.depth_range is not None:
        entry["depth_range"] = list(camera.depth_range)
    return {**entry, "extrinsics": camera.extrinsics.tolist()}
