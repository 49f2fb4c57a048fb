"""The input files of a scene: local ones as they are, those in a store downloaded into a bounded cache."""

import glob
import os
import posixpath
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from ..cameras.discovery import find_cameras
from ..cameras.formats import CAMERA_SUFFIXES, ESTIMATE
from ..cameras.io import input_files
from ..errors import InputError
from ..images.finding import SUFFIXES, VIDEO_SUFFIXES, find_images, is_video
from .cache import InputCache, StoredFile
from .places import open_store, store_errors
from .results import file_sha256, store_tag
from .scenes import Scene


class FileHash(NamedTuple):
    """An input file, by its path relative to the images, and what changes with its content."""

    name: str
    content: str


class LocalInputs:
    """The inputs of a scene on this machine."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def hashes(self) -> list[FileHash]:
        """The hash of each file; raises InputError if there are no images, OSError if a file cannot be read."""
        paths = input_paths(self.scene)
        return [FileHash(os.path.relpath(path, self.scene.images), file_sha256(path)) for path in paths]

    @contextmanager
    def local(self) -> Iterator[Scene]:
        """The scene with local paths."""
        yield self.scene


class StoredInputs:
    """The inputs of a scene of which some are in a store. Raises InputError if they cannot be listed."""

    def __init__(self, scene: Scene, cache: InputCache) -> None:
        self.scene, self._cache = scene, cache
        self._files: dict[str, StoredFile] = {}
        self._images = self._list_images(scene.images) if isinstance(scene.images, str) else scene.images
        self._cameras = scene.cameras
        if isinstance(scene.cameras, str) and scene.cameras != ESTIMATE:
            self._cameras = self._add(scene.cameras, CAMERA_SUFFIXES)

    def hashes(self) -> list[FileHash]:
        """Size and checksum of each file as the store gives them; where it gives none, or files are local, by content.

        Raises InputError and OSError as `LocalInputs.hashes`, and if a file cannot be downloaded.
        """
        is_local = isinstance(self.scene.images, Path) or isinstance(self.scene.cameras, Path)
        if is_local or not all(file.tag for file in self._files.values()):
            with self.local() as scene:
                return LocalInputs(scene).hashes()
        root = str(self._images)
        return [
            FileHash(posixpath.relpath(file.path, root), f"{file.size} {file.tag}") for file in self._files.values()
        ]

    @contextmanager
    def local(self) -> Iterator[Scene]:
        """The scene with local paths, whose files stay for the block."""
        with self._cache.holding(list(self._files.values())) as folder:
            images, cameras = self._images, self._cameras
            if isinstance(images, str):
                below = folder / images.lstrip("/")
                is_glob = glob.has_magic(images) and not below.exists()
                images = Path(glob.escape(str(folder)), images.lstrip("/")) if is_glob else below
            if isinstance(cameras, str) and cameras != ESTIMATE:
                cameras = folder / cameras.lstrip("/")
            yield replace(self.scene, images=images, cameras=cameras)

    def _list_images(self, url: str) -> str:
        """List images, and the cameras among them or, of a glob or a video, beside them; the path in the store."""
        kinds = (*SUFFIXES, *VIDEO_SUFFIXES, *CAMERA_SUFFIXES)
        path = self._add(url, kinds)
        if PurePosixPath(path).suffix.lower() in kinds and self.scene.cameras is None:
            self._add(posixpath.dirname(url), CAMERA_SUFFIXES, depth=1)
        return path

    def _add(self, url: str, suffixes: tuple[str, ...], depth: int | None = None) -> str:
        """List the files of these endings at a URL: one file, all below a folder, or those that match a glob."""
        store, path = open_store(url)
        with store_errors(url):
            found = store.find(path, maxdepth=depth, detail=True)
            if not found and glob.has_magic(path):
                found = store.glob(path, detail=True)
        for name, info in sorted(found.items()):
            if ".." in PurePosixPath(name).parts:
                raise InputError(f"{url}: holds {name!r}, which is no file name; rename it")
            if info["type"] == "file" and PurePosixPath(name).suffix.lower() in suffixes:
                self._files[name] = StoredFile(url, name, int(info["size"]), store_tag(info))
        if not found and depth is None:
            raise InputError(f"{url}: no such file or folder, nor a pattern that matches one")
        return path


def open_inputs(scene: Scene, cache: InputCache) -> LocalInputs | StoredInputs:
    """The inputs of a scene; raises InputError if they are in a store and cannot be listed."""
    is_local = isinstance(scene.images, Path) and (not isinstance(scene.cameras, str) or scene.cameras == ESTIMATE)
    return LocalInputs(scene) if is_local else StoredInputs(scene, cache)


def input_paths(scene: Scene) -> list[Path]:
    """The image and camera files that a local scene is made from. Raises InputError if there are no images."""
    images_place = Path(scene.images)
    if scene.cameras is None:
        found = find_cameras([images_place])
        given, cameras = found.images, found.cameras
    else:
        given, cameras = [images_place], None if scene.cameras == ESTIMATE else Path(scene.cameras)
    images = given if all(path.is_file() and is_video(path) for path in given) else find_images(given)
    return [*images, *(path for path in input_files(cameras) if path.is_file())] if cameras else list(images)
