"""The files of results, in a folder or a store: each is written whole or not at all."""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol

from ..errors import InputError
from ..system.files import atomic_write, make_folder, open_regular, remove_abandoned_folders, scratch_folder
from .places import Place, open_store, store_errors

BLOCK_BYTES = 1 << 20
# What stores call the checksum or version of an object, in order of preference.
TAGS = ("ETag", "etag", "md5Hash", "crc32c")


class Results(Protocol):
    """The files of results in one place. All methods raise InputError for what cannot be read or written."""

    def read(self, name: str) -> bytes | None:
        """The content of a file; None where there is none."""

    def exists(self, name: str) -> bool:
        """Whether there is such a file."""

    def writing(self, name: str) -> AbstractContextManager[Path]:
        """A temporary path of this name, whose file is at its place when the block has ended without an exception."""

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""

    def tidy(self) -> None:
        """Remove what a killed process left here of a file that it was writing."""

    def describe(self, name: str) -> dict[str, Any]:
        """What is kept in the record of a file that was written here, to know it by: its size and hash."""

    def is_whole(self, name: str, described: Mapping[str, Any]) -> bool:
        """Whether a file is the one that was described."""


def open_results(place: Place) -> Results:
    """The results in a folder or a store; the folder need not exist."""
    return LocalResults(place) if isinstance(place, Path) else StoreResults(place)


class LocalResults:
    """Results in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str) -> bytes | None:
        """The content of a file; None where there is none that can be read."""
        try:
            with open_regular(self.folder / name) as file:
                return file.read()
        except (OSError, InputError):
            return None

    def exists(self, name: str) -> bool:
        """Whether there is such a file."""
        path = self.folder / name
        return path.exists() or path.is_symlink()

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary path, whose file is at its place when the block has ended without an exception."""
        make_folder(self.folder)
        with atomic_write(self.folder / name) as temporary:
            yield temporary

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""
        (self.folder / name).unlink(missing_ok=True)

    def tidy(self) -> None:
        """Remove what a killed process left here."""
        remove_abandoned_folders(self.folder)

    def describe(self, name: str) -> dict[str, Any]:
        """What is kept of a file that was written here, to know it by."""
        path = self.folder / name
        return {"bytes": path.stat().st_size, "sha256": file_sha256(path)}

    def is_whole(self, name: str, described: Mapping[str, Any]) -> bool:
        """Whether a file is the one that was described, by its content."""
        path = self.folder / name
        return path.is_file() and file_sha256(path) == described.get("sha256")


class StoreResults:
    """Results in a store, which need not be able to rename: an object is sent when it is whole."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._store, self._root = open_store(url)
        self._sha256: dict[str, str] = {}

    def read(self, name: str) -> bytes | None:
        """The content of a file; None where there is none that can be read."""
        with store_errors(f"{self.url}/{name}"):
            try:
                content: bytes = self._store.cat_file(f"{self._root}/{name}")
                return content
            except FileNotFoundError:
                return None

    def exists(self, name: str) -> bool:
        """Whether there is such a file."""
        return self._info(name) is not None

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary path, whose file is at its place when the block has ended without an exception."""
        with scratch_folder() as folder:
            temporary = folder / name
            yield temporary
            with store_errors(f"{self.url}/{name}"):
                self._store.put_file(str(temporary), f"{self._root}/{name}")
            self._sha256[name] = file_sha256(temporary)

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""
        with store_errors(f"{self.url}/{name}"):
            if self._store.exists(f"{self._root}/{name}"):
                self._store.rm_file(f"{self._root}/{name}")

    def tidy(self) -> None:
        """Do nothing: a store shows no object that was not sent to its end."""

    def describe(self, name: str) -> dict[str, Any]:
        """What is kept of a file that was written here, to know it by."""
        info = self._info(name) or {}
        return {"bytes": info.get("size"), "sha256": self._sha256.get(name), "tag": store_tag(info)}

    def is_whole(self, name: str, described: Mapping[str, Any]) -> bool:
        """By size and the store's checksum, without reading the object; by size alone where there is no checksum."""
        info = self._info(name)
        return info is not None and (info.get("size"), store_tag(info)) == (described["bytes"], described.get("tag"))

    def _info(self, name: str) -> dict[str, Any] | None:
        with store_errors(f"{self.url}/{name}"):
            try:
                info: dict[str, Any] = self._store.info(f"{self._root}/{name}")
                return info if info.get("type") == "file" else None
            except FileNotFoundError:
                return None


def store_tag(info: Mapping[str, Any]) -> str | None:
    """The checksum or version that a store gives of an object; None where it gives none."""
    return next((str(info[name]) for name in TAGS if info.get(name)), None)


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file's content."""
    with open_regular(path) as file:
        digest = hashlib.sha256()
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
