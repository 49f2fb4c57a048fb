"""Files that appear whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import InputError, refuse
from .limits import EXPANSION

# What small files may take in memory, however well they are compressed.
ALWAYS_ALLOWED = 1 << 26  # bytes


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix) that replaces it once the block ends without an exception.

    A killed run leaves the old file or the new one, never half of one.
    Raises InputError if the folder cannot be written.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        reason = f"cannot write {path}: {error.strerror}"
        raise InputError(f"{reason}; choose a folder that exists and is writable") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose a file on a disk with room for it") from None
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: Path, expected: str, largest: int | None = None) -> bytes:
    """The content of a file; raises InputError, naming what was expected, if it cannot be read, or is empty.

    largest: bytes from which on it cannot be what was expected, either.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if largest is not None and size > largest:
            refuse(path, f"has {size >> 20} MiB", f"expected {expected}")
        content = path.read_bytes()
    except OSError as error:
        refuse(path, f"cannot be read ({error.strerror})", f"expected {expected}")
    if not content:
        refuse(path, "is empty", f"expected {expected}")
    return content


def check_expansion(path: Path, unpacked: int, packed: int) -> None:
    """Refuse a file of `packed` bytes that claims to hold so many more, before they take memory."""
    if unpacked > max(ALWAYS_ALLOWED, EXPANSION.value * packed):
        raise InputError(
            f"{path}: {packed} bytes that claim to hold {unpacked} are no scene; copy or download it again, or "
            f"{EXPANSION.remedy}"
        )


def make_folder(path: Path) -> Path:
    """Create `path` and its parents; raises InputError where that is not possible."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create the folder {path}: {error.strerror}; choose another output folder") from None
    return Path(path)


def check_writable(folder: Path) -> None:
    """Raise InputError unless files can be written into an existing folder; to be asked before long work."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose a folder that exists") from None


def _umask() -> int:
    """The process's umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
