"""The scenes of a batch: a folder of scene folders, or a table of them in .jsonl or .csv."""

import csv
import io
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, TextIO

from ..cameras.formats import ESTIMATE, CameraFormat
from ..errors import InputError, error_context, raise_input_error
from ..images.sizes import parse_size
from ..inference.inputs import parse_views
from ..reconstruction.bounds import check_depth_bounds, check_max_gaussians
from ..reconstruction.quality import Quality, parse_refine
from ..splats.filtering import FilterOptions
from ..system.files import open_regular, without_case
from ..views.exposure_mode import ExposureMode
from ..views.world_offset import AUTO, parse_offset
from .places import Place, beside, join, open_store, parse_place, store_errors

EXPECTED = "expected a folder of scene folders, or a .jsonl or .csv with a row for each scene"
# What is a folder's name on every system, and no hidden one.
ID = re.compile(r"""[^\x00-\x1f\x7f/\\:*?"<>|.][^\x00-\x1f\x7f/\\:*?"<>|]*""")
MAX_ID_BYTES = 200
RESERVED = ".json"  # the ending of the summary, which stands beside the scenes' folders
TABLES = (".jsonl", ".csv")
FLAGS = {"true": True, "1": True, "false": False, "0": False}


def _one_of(kind: type[StrEnum]) -> Callable[[str], StrEnum]:
    def parse(text: str) -> StrEnum:
        try:
            return kind(text)
        except ValueError:
            raise InputError(f"expected one of {', '.join(kind)}") from None

    return parse


def parse_flag(text: str) -> bool:
    """Whether a text says true; raises InputError unless it is true, false, 1 or 0 in small or capital letters."""
    if text.lower() not in FLAGS:
        raise InputError("expected true or false")
    return FLAGS[text.lower()]


# Options of one scene, called as in `reconstruct` and `FilterOptions`, and how each is read from text.
FILTERS: dict[str, Callable[[str], Any]] = {
    "min_opacity": float,
    "crop_border": int,
    "max_depth_jump": float,
    "min_consistency": float,
    "remove_contradicted": parse_flag,
    "merge_duplicates": parse_flag,
    "close_holes": parse_flag,
}
OPTIONS: dict[str, Callable[[str], Any]] = {
    "camera_format": _one_of(CameraFormat),
    "focal": str,
    "quality": _one_of(Quality),
    "select": str,
    "views": parse_views,
    "size": parse_size,
    "crop": parse_flag,
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

    images, cameras: a path, or the URL of a store as a string. cameras: a file or folder, "estimate", or None for those
    beside the images. options: by the names in `OPTIONS`.
    """

    id: str
    images: Place
    cameras: Place | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Scenes:
    """The scenes that a folder or a table names. They are read anew by each iteration, so that memory holds one.

    count: how many, in all shards. shard: from 1, and of how many; it has every so many-th scene.
    """

    source: Place
    count: int
    shard: tuple[int, int] = (1, 1)

    def __len__(self) -> int:
        number, shards = self.shard
        return len(range(number - 1, self.count, shards))

    def __iter__(self) -> Iterator[Scene]:
        number, shards = self.shard
        return islice(_read(self.source), number - 1, None, shards)

    def of_shard(self, shard: str | None) -> "Scenes":
        """Those of a shard "I/N"; raises InputError unless I is from 1 to N."""
        return self if shard is None else replace(self, shard=parse_shard(shard))


def read_scenes(source: Path | str) -> Scenes:
    """The scenes that a folder or a table names; relative paths in a table are relative to it.

    Raises InputError for what cannot be read, an unknown column, an invalid id, and an id given twice.
    """
    place = parse_place(source)
    ids: set[str] = set()
    for scene in _read(place):
        name = without_case(scene.id)  # some file systems take names for one that differ in case alone
        if name in ids:
            raise_input_error(place, f"id {name} is given twice", "give each scene its own id")
        ids.add(name)
    if not ids:
        raise_input_error(place, "no scene in it", EXPECTED)
    return Scenes(place, len(ids))


def parse_shard(shard: str) -> tuple[int, int]:
    """The numbers of a shard "I/N"; raises InputError unless I is from 1 to N."""
    parts = shard.split("/")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and len(part) < 10 for part in parts):
        raise InputError(f"--shard {shard[:40]}: expected I/N, such as 1/8")
    number, count = map(int, parts)
    if not 1 <= number <= count:
        raise InputError(f"--shard {shard}: expected a number from 1 to {count}, and how many there are")
    return number, count


def check_options(options: Mapping[str, Any]) -> None:
    """Raise InputError for options that are not in `OPTIONS`, and for values that `reconstruct` would refuse.

    None counts as absent.
    """
    unknown = sorted(set(options) - set(OPTIONS))
    if unknown:
        raise InputError(f"unknown option {unknown[0]!r}; expected {', '.join(OPTIONS)}")
    given = {name: value for name, value in options.items() if value is not None}
    split_filters(given)
    parse_offset(given.get("offset", AUTO))
    parse_refine(given.get("refine", "0"))
    check_max_gaussians(given.get("max_gaussians", 0), "max_gaussians")
    check_depth_bounds(given.get("near"), given.get("far"), prefix="")


def _read(place: Place) -> Iterator[Scene]:
    """The scenes of a folder or a table, one after the other; raises InputError as `read_scenes`."""
    if PurePosixPath(place).suffix.lower() in TABLES and not (isinstance(place, Path) and place.is_dir()):
        for number, row in enumerate(_rows(place), 1):
            yield _scene(row, place, number)
        return
    for name in _folders(place):
        yield Scene(_checked_id(name), join(place, name))


def _folders(place: Place) -> list[str]:
    """The names of the folders in a folder, but for hidden ones."""
    if isinstance(place, str):
        store, path = open_store(place)
        with store_errors(place):
            found = [entry["name"].rstrip("/") for entry in store.ls(path, detail=True) if entry["type"] == "directory"]
        names = [PurePosixPath(name).name for name in found]
    elif place.is_dir():
        with error_context(str(place)), os.scandir(place) as entries:
            names = [entry.name for entry in entries if entry.is_dir()]
    else:
        raise_input_error(place, "is no folder, .jsonl or .csv", EXPECTED)
    return sorted(name for name in names if not name.startswith("."))


def _rows(place: Place) -> Iterator[Any]:
    is_csv = PurePosixPath(place).suffix.lower() == ".csv"
    with _opened(place) as file:
        rows = csv.DictReader(file) if is_csv else (json.loads(line) for line in file if line.strip())
        try:
            yield from rows
        except (ValueError, csv.Error, RecursionError) as error:
            raise_input_error(place, f"cannot be read ({error})", "expected UTF-8 with one scene a line")


@contextmanager
def _opened(place: Place) -> Iterator[TextIO]:
    """A table, as text; raises InputError if there is none."""
    if isinstance(place, str):
        store, path = open_store(place)
        with store_errors(place):
            binary = store.open(path, "rb")
    else:
        try:
            binary = open_regular(place)
        except OSError as error:
            raise_input_error(place, f"cannot be read ({error.strerror})", EXPECTED)
    with io.TextIOWrapper(binary, encoding="utf-8-sig", newline="") as text:
        yield text


def _scene(row: Any, place: Place, number: int) -> Scene:
    with error_context(f"{place}, scene {number}"):
        if not isinstance(row, Mapping):
            raise InputError("expected an object with id and images")
        return make_scene(row, place)


def make_scene(row: Mapping[Any, Any], table: Place) -> Scene:
    """The scene of a row with id, images, cameras and options; relative paths are relative to the table's folder.

    Raises InputError for an unknown column, or an invalid value.
    """
    given = {str(name): str(value) for name, value in row.items() if value not in (None, "")}
    unknown = sorted(set(given) - {"id", "images", "cameras", *OPTIONS})
    if unknown:
        raise InputError(f"unknown column {unknown[0]!r}; expected id, images, cameras, {', '.join(OPTIONS)}")
    if "id" not in given or "images" not in given:
        raise InputError("expected both id and images")
    options = {}
    for name in OPTIONS:
        if name in given:
            with error_context(f"{name} {given[name]!r}"):
                options[name] = parse_option(name, given[name])
    check_options(options)
    cameras = given.get("cameras")
    place = beside(table, cameras) if cameras and cameras != ESTIMATE else cameras
    return Scene(_checked_id(given["id"]), beside(table, given["images"]), place, options)


def parse_option(name: str, text: str) -> Any:
    """The value of an option of `OPTIONS` in text; raises InputError, whose message the caller gives a context."""
    try:
        return OPTIONS[name](text)
    except InputError:
        raise
    except ValueError:
        raise InputError("expected a number") from None


def split_filters(options: Mapping[str, Any]) -> tuple[FilterOptions, dict[str, Any]]:
    """The filters among options, and the other options; raises InputError for filters that cannot be."""
    filters = FilterOptions(**{name: value for name, value in options.items() if name in FILTERS and value is not None})
    return filters, {name: value for name, value in options.items() if name not in FILTERS}


def _checked_id(name: str) -> str:
    if not ID.fullmatch(name) or name.lower().endswith(RESERVED):
        raise InputError(f"id {name!r}: expected a name of a folder, without a leading '.', and none in {RESERVED}")
    if len(os.fsencode(name)) > MAX_ID_BYTES:
        raise InputError(f"id {name[:40]!r}...: expected {MAX_ID_BYTES} bytes at most")
    return name
