"""The record of a scene, written last: a scene is done when its record holds the hash of what it was made from."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ..cameras.formats import ESTIMATE
from ..errors import InputError
from ..inference.model_files import ModelFiles, external_files
from ..splats.io import FORMATS
from .inputs import FileHash
from .results import Results, file_sha256
from .scenes import Scene

RECORD = "record.json"
PICTURE = "picture.jpg"
TRACEBACK = "error.txt"
PLY = "ply"


class Status(StrEnum):
    """The state of a scene.

    STARTED: its process reconstructs it, or was killed; older results are as they were. WRITING: its process replaces
    the results, or was killed.
    """

    STARTED = "started"
    WRITING = "writing"
    DONE = "done"
    FAILED = "failed"


def splats_name(splat_format: str) -> str:
    """The name of a scene's splat file; raises InputError for an unknown format."""
    if f".{splat_format}" not in FORMATS:
        raise InputError(f"--format {splat_format}: expected {', '.join(name[1:] for name in FORMATS)}")
    return f"scene.{splat_format}"


def model_sha256(model: ModelFiles) -> str:
    """The hash of all files of a model, wherever they stand."""
    digest = hashlib.sha256()
    for stage in model.stages:
        graph = model.file_of(stage)
        for path in (graph, *external_files(graph)):
            digest.update(f"{path.name}\0{file_sha256(path)}\0".encode())
    return digest.hexdigest()


def fingerprint(
    scene: Scene, inputs: Sequence[FileHash], options: Mapping[str, Any], model: str, provider: str, splats: str
) -> str:
    """The hash of a scene's input files, the options, the model, the provider, the format and idesplat's version."""
    settings = [version("idesplat"), model, provider, splats, sorted(options.items()), str(scene.cameras == ESTIMATE)]
    digest = hashlib.sha256(json.dumps(settings, default=str).encode())
    for name, content in inputs:
        digest.update(f"{name}\0{content}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def read_record(results: Results) -> dict[str, Any] | None:
    """The record in a scene's results; None where there is none or it cannot be read."""
    try:
        record = json.loads(results.read(RECORD) or b"")
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and record.get("status") in tuple(Status) else None


def is_done(results: Results, record: Mapping[str, Any], made_from: str) -> bool:
    """Whether a scene was made from these inputs and the files that its record names are there, whole."""
    if record.get("status") != Status.DONE or record.get("hash") != made_from:
        return False
    files = files_of(record)
    return bool(files) and all(results.is_whole(name, described) for name, described in files.items())


def files_of(record: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The files that a record names, and what it says of them; those alone that a batch may have written."""
    files = record.get("files")
    known = {PICTURE, *(splats_name(name[1:]) for name in FORMATS)}
    if not isinstance(files, dict):
        return {}
    return {name: described for name, described in files.items() if name in known and isinstance(described, dict)}


def write_record(results: Results, record: Mapping[str, Any]) -> None:
    """Write a record whole or not at all; raises InputError if it cannot be written."""
    write_text(results, RECORD, json.dumps(record, indent=2) + "\n")


def write_text(results: Results, name: str, text: str) -> None:
    """Write a text whole or not at all; raises InputError if it cannot be written."""
    with results.writing(name) as temporary:
        Path(temporary).write_text(text, encoding="utf-8", errors="backslashreplace")


def check_own(results: Results, place: object, splats: str) -> None:
    """Raise InputError if a file would be replaced that is no result of a batch."""
    if read_record(results) is not None:
        return
    for name in (splats, PICTURE, RECORD):
        if results.exists(name):
            raise InputError(
                f"{place}: {name} exists, and idesplat batch did not write it; choose another --out, or add "
                "--overwrite to replace it"
            )
