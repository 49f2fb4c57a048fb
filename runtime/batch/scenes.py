"""The scenes of a batch: a folder of scene folders, or a table of them in .jsonl or .csv."""

import csv
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..cameras.formats import ESTIMATE, CameraFormat
from ..errors import InputError, error_context, raise_input_error
from ..images.sizes import parse_size
from ..inference.inputs import parse_views
from ..reconstruction.quality import Quality
from ..system.files import read_bytes, without_case
from ..views.exposure_mode import ExposureMode

EXPECTED = "expected a folder of scene folders, or a .jsonl or .csv with a row for each scene"
# What is a folder's name on every system, and no hidden one.
ID = re.compile(r"""[^\x00-\x1f\x7f/\\:*?"<>|.][^\x00-\x1f\x7f/\\:*?"<>|]*""")
MAX_ID_BYTES = 200
RESERVED = ".json"  # the ending of the summary, which stands beside the scenes' folders
URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+:/")
FLAGS = {"true": True, "1": True, "false": False, "0": False}


def _one_of(kind: type[StrEnum]) -> Callable[[str], StrEnum]:
    def parse(text: str) -> StrEnum:
        try:
            return kind(text)
        except ValueError:
            raise InputError(f"expected one of {', '.join(kind)}") from None

    return parse


def _flag(text: str) -> bool:
    if text.lower() not in FLAGS:
        raise InputError("expected true or false")
    return FLAGS[text.lower()]


# Options of one scene, called as in `reconstruct` and `FilterOptions`, and how each is read from text.
FILTERS: dict[str, Callable[[str], Any]] = {
    "min_opacity": float,
    "crop_border": int,
    "max_depth_jump": float,
    "min_consistency": float,
    "remove_contradicted": _flag,
    "merge_duplicates": _flag,
    "close_holes": _flag,
}
OPTIONS: dict[str, Callable[[str], Any]] = {
    "camera_format": _one_of(CameraFormat),
    "focal": str,
    "quality": _one_of(Quality),
    "select": str,
    "views": parse_views,
    "size": parse_size,
    "crop": _flag,
    "refine": str,
    "max_gaussians": int,
    "near": float,
    "far": float,
    "offset": str,
    "exposure": _one_of(ExposureMode),
    **FILTERS,
}


@dataclass(frozen=True)
class Scene:
    """One scene: its id, a folder of images, a glob or a video, and where its cameras are.

    cameras: a file or folder, "estimate", or None for those beside the images. options: by the names in `OPTIONS`.
    """

    id: str
    images: Path
    cameras: Path | str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


def read_scenes(path: Path) -> list[Scene]:
    """The scenes that a folder or a table names; relative paths in a table are relative to it.

    Raises InputError for what cannot be read, an unknown column, an invalid id, and an id given twice.
    """
    check_local(str(path))
    if os.path.isdir(path):
        with error_context(str(path)):
            scenes = [Scene(_checked_id(entry.name), entry) for entry in sorted(path.iterdir()) if _is_scene(entry)]
    else:
        scenes = [_scene(row, path, number) for number, row in enumerate(_rows(path), 1)]
    if not scenes:
        raise_input_error(path, "no scene in it", EXPECTED)
    # Some file systems take names for one that differ in case alone.
    twice = [name for name, count in Counter(without_case(scene.id) for scene in scenes).items() if count > 1]
    if twice:
        raise_input_error(path, f"id {twice[0]} is given twice", "give each scene its own id")
    return scenes


def check_local(path: str) -> None:
    """Raise InputError for a URL, or a name that no file can have."""
    if URL.match(path):
        raise InputError(f"{path}: is a URL, expected a local path")
    try:
        invalid = b"\0" in os.fsencode(path)
    except ValueError:
        invalid = True
    if invalid:
        raise InputError(f"{path!a}: no file can have this name; give a local path")


def _is_scene(entry: Path) -> bool:
    return entry.is_dir() and not entry.name.startswith(".")


def _rows(path: Path) -> list[Any]:
    if path.suffix.lower() not in (".jsonl", ".csv"):
        raise_input_error(path, "is no folder, .jsonl or .csv", EXPECTED)
    content = read_bytes(path, "a list of scenes")
    try:
        lines = content.decode("utf-8-sig").splitlines()
        if path.suffix.lower() == ".csv":
            return list(csv.DictReader(lines))
        return [json.loads(line) for line in lines if line.strip()]
    except (ValueError, csv.Error, RecursionError) as error:
        raise_input_error(path, f"cannot be read ({error})", "expected UTF-8 with one scene a line")


def _scene(row: Any, path: Path, number: int) -> Scene:
    with error_context(f"{path}, scene {number}"):
        if not isinstance(row, Mapping):
            raise InputError("expected an object with id and images")
        given = {str(name): str(value) for name, value in row.items() if value not in (None, "")}
        unknown = sorted(set(given) - {"id", "images", "cameras", *OPTIONS})
        if unknown:
            raise InputError(f"unknown column {unknown[0]!r}; expected id, images, cameras, {', '.join(OPTIONS)}")
        if "id" not in given or "images" not in given:
            raise InputError("expected both id and images")
        options = {name: _parsed(name, given[name]) for name in OPTIONS if name in given}
        images, cameras = given["images"], given.get("cameras")
        check_local(images)
        check_local(cameras or "")
        place = path.parent / cameras if cameras and cameras != ESTIMATE else cameras
        return Scene(_checked_id(given["id"]), path.parent / images, place, options)


def _parsed(name: str, text: str) -> Any:
    with error_context(f"{name} {text!r}"):
        try:
            return OPTIONS[name](text)
        except InputError:
            raise
        except ValueError:
            raise InputError("expected a number") from None


def _checked_id(name: str) -> str:
    if not ID.fullmatch(name) or name.lower().endswith(RESERVED):
        raise InputError(f"id {name!r}: expected a name of a folder, without a leading '.', and none in {RESERVED}")
    if len(os.fsencode(name)) > MAX_ID_BYTES:
        raise InputError(f"id {name[:40]!r}...: expected {MAX_ID_BYTES} bytes at most")
    return name
