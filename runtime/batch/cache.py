"""The cache of downloaded inputs: bounded in bytes, what was not used for the longest time goes first."""

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from ..system.cache_folder import cache_folder
from ..system.files import LOCK_NAME, make_folder, scratch_folder
from .places import open_store, store_errors

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FOLDER = "inputs"
DEFAULT_GB = 10.0
GB = 10**9
DOWNLOADS = 8  # at a time
REMOVED = "removed"
ENTRY = re.compile(r"[0-9a-f]{32}-(\d+)")  # the hash of what it holds, and its bytes


class StoredFile(NamedTuple):
    """A file in a store. url: any in this store. tag: the store's checksum, None where it gives none."""

    url: str
    path: str
    size: int
    tag: str | None


class InputCache:
    """Downloaded files of scenes, shared by the processes of this user.

    limit: bytes. The files of scenes under way stay whatever their size.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit

    @contextmanager
    def holding(self, files: Sequence[StoredFile]) -> Iterator[Path]:
        """A folder with files at their paths in the store, which stay for the block; downloads what is missing.

        Raises InputError if a file cannot be downloaded or there is no room for it.
        """
        if fcntl is None or not all(file.tag for file in files):  # without locks or versions nothing can be kept
            with scratch_folder(make_folder(cache_folder(FOLDER))) as scratch:
                _download(files, scratch)
                yield scratch
            return
        key = hashlib.sha256(repr([(file.url.partition("://")[0], *file[1:]) for file in files]).encode())
        entry = cache_folder(FOLDER) / f"{key.hexdigest()[:32]}-{sum(file.size for file in files)}"
        while (lock := _take(entry)) is None:
            self._fetch(files, entry)
        try:
            yield entry
        finally:
            os.close(lock)

    def _fetch(self, files: Sequence[StoredFile], entry: Path) -> None:
        self._make_room(sum(file.size for file in files))
        with scratch_folder(make_folder(entry.parent)) as scratch:
            folder = scratch / "files"
            folder.mkdir()
            _download(files, folder)
            (folder / LOCK_NAME).touch()
            _move_if_broken(entry, scratch)
            with suppress(OSError):  # another process was faster
                folder.rename(entry)

    def _make_room(self, needed: int) -> None:
        """Remove what was not used for the longest time, until the files fit."""
        with suppress(FileNotFoundError):
            found = [
                (entry, match) for entry in os.scandir(cache_folder(FOLDER)) if (match := ENTRY.fullmatch(entry.name))
            ]
            total = needed + sum(int(match[1]) for _, match in found)
            for entry, match in sorted(found, key=lambda pair: pair[0].stat().st_mtime):
                if total <= self.limit:
                    break
                if _remove_if_unused(Path(entry.path)):
                    total -= int(match[1])


def _download(files: Sequence[StoredFile], folder: Path) -> None:
    """Download files to their paths below a folder; raises InputError."""

    def download(file: StoredFile) -> None:
        target = folder / file.path.lstrip("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        store, _ = open_store(file.url)
        with store_errors(file.url):
            store.get_file(file.path, str(target))

    with ThreadPoolExecutor(DOWNLOADS) as pool:
        list(pool.map(download, files))


def _take(entry: Path) -> int | None:
    """Keep an entry from being removed until the returned descriptor is closed; None where there is no entry."""
    try:
        lock = os.open(entry / LOCK_NAME, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    fcntl.flock(lock, fcntl.LOCK_SH)
    if not _is_lock_of(lock, entry):  # it was removed meanwhile
        os.close(lock)
        return None
    os.utime(entry)
    return lock


def _remove_if_unused(entry: Path) -> bool:
    try:
        lock = os.open(entry / LOCK_NAME, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        with scratch_folder(entry.parent) as scratch:
            _move_if_broken(entry, scratch)
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _is_lock_of(lock, entry):
            return False
        with scratch_folder(entry.parent) as scratch:  # it is gone at once, so that a new one may take its place
            entry.rename(scratch / REMOVED)
        return True
    except BlockingIOError:
        return False
    finally:
        os.close(lock)


def _is_lock_of(lock: int, entry: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(lock), os.stat(entry / LOCK_NAME))
    except FileNotFoundError:
        return False


def _move_if_broken(entry: Path, scratch: Path) -> None:
    """Move an entry without a lock, which an older version was killed while removing, into a folder that is removed."""
    with suppress(OSError):
        if not (entry / LOCK_NAME).exists():
            entry.rename(scratch / REMOVED)
            if (scratch / REMOVED / LOCK_NAME).exists():  # another process had just put a new one there
                (scratch / REMOVED).rename(entry)
