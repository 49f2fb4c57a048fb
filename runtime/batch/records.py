"""The record of a scene, written last: a scene is done when its record holds the hash of what it was made from."""

import hashlib
import json
import os
from collections.abc import Mapping
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ..cameras.discovery import find_cameras
from ..cameras.formats import ESTIMATE
from ..cameras.io import input_files
from ..images.finding import find_images, is_video
from ..inference.model_files import ModelFiles, external_files
from ..system.files import atomic_write, open_regular
from .scenes import Scene

RECORD = "record.json"
SPLATS = "scene.ply"
TRACEBACK = "error.txt"
BLOCK_BYTES = 1 << 20


class Status(StrEnum):
    """The state of a scene. STARTED: its process works on it, or was killed."""

    STARTED = "started"
    DONE = "done"
    FAILED = "failed"


def model_sha256(model: ModelFiles) -> str:
    """The hash of all files of a model, wherever they stand."""
    digest = hashlib.sha256()
    for stage in model.stages:
        graph = model.file_of(stage)
        for path in (graph, *external_files(graph)):
            digest.update(f"{path.name}\0{file_sha256(path)}\0".encode())
    return digest.hexdigest()


def fingerprint(scene: Scene, options: Mapping[str, Any], model: str, provider: str) -> str:
    """The hash of a scene's image and camera files, the options, the model, the provider and idesplat's version.

    Raises InputError if there are no images, and OSError if a file cannot be read.
    """
    settings = [version("idesplat"), model, provider, sorted(options.items()), str(scene.cameras == ESTIMATE)]
    digest = hashlib.sha256(json.dumps(settings, default=str).encode())
    for path in input_paths(scene):
        digest.update(f"{os.path.relpath(path, scene.images)}\0{file_sha256(path)}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def input_paths(scene: Scene) -> list[Path]:
    """The image and camera files that a scene is made from. Raises InputError if there are no images."""
    if scene.cameras is None:
        found = find_cameras([scene.images])
        given, cameras = found.images, found.cameras
    else:
        given, cameras = [scene.images], None if scene.cameras == ESTIMATE else Path(scene.cameras)
    images = given if all(path.is_file() and is_video(path) for path in given) else find_images(given)
    return [*images, *(path for path in input_files(cameras) if path.is_file())] if cameras else list(images)


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file's content."""
    with open_regular(path) as file:
        digest = hashlib.sha256()
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record in a scene's output folder; None where there is none or it cannot be read."""
    try:
        with open_regular(folder / RECORD) as file:
            record = json.loads(file.read())
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and record.get("status") in tuple(Status) else None


def is_done(folder: Path, record: Mapping[str, Any], made_from: str) -> bool:
    """Whether a scene was made from these inputs and its splats are there, whole."""
    if record.get("status") != Status.DONE or record.get("hash") != made_from:
        return False
    splats = folder / SPLATS
    return splats.is_file() and file_sha256(splats) == record.get("sha256")


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Write a record whole or not at all; raises InputError if it cannot be written."""
    with atomic_write(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
