"""Reading regular files only, and writing files atomically."""

import logging
import os
import re
import shutil
import stat
import tempfile
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO, Protocol

from ..errors import InputError, raise_input_error
from .limits import EXPANSION

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# Decompressed size that is allowed whatever the size of the file.
ALWAYS_ALLOWED = 1 << 26  # bytes
SCRATCH_PREFIX = ".idesplat-tmp-"
SCRATCH_NAME = re.compile(re.escape(SCRATCH_PREFIX) + r"\w{8}")  # as tempfile.mkdtemp completes it
LOCK_NAME = ".idesplat-lock"
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}

_collected: set[Path] = set()


class WriteGuard(Protocol):
    """Asked before a file is written, and told afterwards (see `outputs`)."""

    def check(self, path: Path) -> None:
        """Raise InputError if the file must not be written; create its folder if it is missing."""

    def written(self, path: Path) -> None:
        """Record a file that has been written."""


LOG = logging.getLogger(__name__)

GUARD: ContextVar[WriteGuard | None] = ContextVar("GUARD", default=None)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path of the same name, which replaces `path` when the block ends without an exception.

    A killed process leaves the old file or the new one, never a partial one.
    Raises InputError if the folder cannot be written, or the running command must not replace the file.
    """
    path, guard = Path(path), GUARD.get()
    if guard is not None:
        guard.check(path)
    try:
        with scratch_folder(path.parent) as folder:
            temporary = folder / path.name
            yield temporary
            temporary.replace(path)
        LOG.debug("wrote %s", path)
        if guard is not None:
            guard.written(path)
    except OSError as error:
        reason = f"cannot write {path}: {error.strerror or error}"
        raise InputError(f"{reason}; choose a folder that exists, is writable and has room for it") from None


@contextmanager
def scratch_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder in `parent`, or in the system's folder for temporary files, that is removed after the block.

    Folders of this kind that killed processes left in `parent` are removed first, once for each process and parent. A
    process locks its folder, and the system releases the lock when the process ends: a folder in use is never removed.
    Raises OSError if the folder cannot be made.
    """
    parent = Path(parent or tempfile.gettempdir())
    remove_abandoned_folders(parent)
    folder, lock = _make_locked(parent)
    try:
        yield folder
    finally:
        if lock is not None:
            os.close(lock)  # before the file is removed: NFS and Windows keep files that are open
        shutil.rmtree(folder, ignore_errors=True)


def remove_abandoned_folders(parent: Path) -> None:
    """Remove the scratch folders that killed processes of this user left in `parent`; only when first asked to."""
    if fcntl is None or parent in _collected:
        return
    _collected.add(parent)
    with suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if SCRATCH_NAME.fullmatch(entry.name):
                with suppress(OSError):
                    _remove_if_abandoned(entry)


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading in binary.

    Raises InputError for other kinds of files: a named pipe would block, and a device may be infinite.
    Raises OSError as `open` does.
    """
    check_regular(path)
    # The file can be replaced between the check and the opening: so it is opened without blocking, and checked again.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_kind(path, os.fstat(descriptor))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: Path) -> None:
    """Raise InputError if the path is not a regular file, before a library opens it by its name.

    Raises OSError if there is no such file.
    """
    try:
        status = os.stat(path)
    except ValueError:  # NUL and lone surrogates
        raise_input_error(path, "is not a valid file name", "give the path of a file")
    _check_kind(path, status)


def read_bytes(path: Path, expected: str, largest: int | None = None) -> bytes:
    """The content of a regular file. Raises InputError, naming what was `expected`, if it is not readable or is empty.

    largest: maximum size in bytes.
    """
    path = Path(path)
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if largest is not None and size > largest:
                raise_input_error(path, f"has {size >> 20} MiB", f"expected {expected}")
            content = file.read()
    except OSError as error:
        raise_input_error(path, f"cannot be read ({error.strerror})", f"expected {expected}")
    except MemoryError:
        raise_input_error(path, f"has {size >> 20} MiB, more than memory has room for", f"expected {expected}")
    if not content:
        raise_input_error(path, "is empty", f"expected {expected}")
    return content


def check_expansion(path: Path, unpacked: int, packed: int) -> None:
    """Raise InputError if `packed` bytes declare too large an unpacked size, before it is allocated."""
    if unpacked > max(ALWAYS_ALLOWED, EXPANSION.value * packed):
        raise InputError(
            f"{path}: {packed} bytes that claim to hold {unpacked} are no scene; copy or download it again, or "
            f"{EXPANSION.remedy}"
        )


def make_folder(path: Path) -> Path:
    """Create `path` and its parents. Raises InputError if that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create the folder {path}: {error.strerror}; choose another output folder") from None
    return Path(path)


def check_writable(folder: Path) -> None:
    """Raise InputError unless the folder exists and is writable; a check before long work."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose a folder that exists") from None


def _check_kind(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = KINDS.get(stat.S_IFMT(status.st_mode), "no regular file")
        raise_input_error(path, f"is {kind}", "expected a regular file; save what it holds to one")


def _make_locked(parent: Path) -> tuple[Path, int | None]:
    """A new folder with a locked file in it, and that file's descriptor; None where the system has no such locks."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=SCRATCH_PREFIX, dir=parent))
        if fcntl is None:
            return folder, None
        try:
            lock = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except FileNotFoundError:  # another process took the folder for an abandoned one, before there was a lock
            continue
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        if _lock(lock) is not False and (folder / LOCK_NAME).exists():
            return folder, lock
        os.close(lock)


def _lock(descriptor: int) -> bool | None:
    """Whether the file is this process's own from now on; None where the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _remove_if_abandoned(entry: os.DirEntry[str]) -> None:
    if not entry.is_dir(follow_symlinks=False) or entry.stat(follow_symlinks=False).st_uid != os.getuid():
        return
    try:
        lock = os.open(Path(entry.path, LOCK_NAME), os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        os.rmdir(entry.path)  # its process was killed, or is about to lock it and will then make another one
        return
    try:
        if _lock(lock):
            shutil.rmtree(entry.path, ignore_errors=True)
    finally:
        os.close(lock)


def without_case(text: str) -> str:
    """The same for names that a file system may take for one: Windows and macOS ignore case, macOS how é is encoded."""
    return unicodedata.normalize("NFC", text).casefold()
