"""Records of the files that commands have written, so that later commands replace these files and no others.

There is one record for each output folder, in the cache folder. It lists file names with size and modification time.
A mark inside the files is not possible: .splat and .xyz have no room for it, and an edited file would keep it. A file
that was changed, copied or moved since it was written, or that is not in the record, is never replaced.
"""

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from .cache_folder import cache_folder
from .files import scratch_folder

KEY_LENGTH = 32  # hexadecimal digits
SUFFIX = ".jsonl"
LEAST_STALE_LINES = 1000  # below which a record is not rewritten without them
MOST_RECORDS = 2000  # folders that are remembered; those not written to for longest are forgotten


class WrittenFile(NamedTuple):
    """A file as the command left it. changed_ns: time of its last change in nanoseconds."""

    command: str
    size: int
    changed_ns: int


def read_record(folder: Path) -> dict[str, WrittenFile]:
    """The files that commands have written into a folder, by name; none where there is no record."""
    found: dict[str, WrittenFile] = {}
    lines: list[str] = []
    with suppress(OSError, RuntimeError):
        record = _record_path(folder)
        if record.is_file():  # a pipe would block
            lines = record.read_text("ascii", errors="replace").splitlines()
    for line in lines:
        # Truncated and damaged lines are ignored.
        with suppress(ValueError, TypeError, OverflowError, RecursionError):
            name, command, size, changed_ns = json.loads(line)
            if isinstance(name, str):
                found[name] = WrittenFile(str(command), int(size), int(changed_ns))
    if len(lines) > 2 * len(found) + LEAST_STALE_LINES:
        _rewrite(folder, found)
    return found


def add_to_record(path: Path, command: str) -> None:
    """Record that `command` has written a file; without effect if the cache folder is not writable."""
    with suppress(OSError, RuntimeError):
        status = path.lstat()
        record = _record_path(path.parent)
        if not record.exists():
            record.parent.mkdir(parents=True, exist_ok=True)
            _forget_oldest(record.parent)
        elif not record.is_file():
            return
        line = _line(path.name, WrittenFile(command, status.st_size, status.st_mtime_ns))
        with record.open("a", encoding="ascii") as file:
            file.write(line)  # in one call, so that lines of several processes do not mix


def is_unchanged(path: Path, entry: WrittenFile | None) -> bool:
    """Whether a file still has the size and modification time of its entry."""
    if entry is None:
        return False
    try:
        status = path.lstat()
    except OSError:
        return False
    return (status.st_size, status.st_mtime_ns) == (entry.size, entry.changed_ns)


def _record_path(folder: Path) -> Path:
    key = hashlib.sha256(os.fsencode(os.path.realpath(folder))).hexdigest()[:KEY_LENGTH]
    return cache_folder("written") / (key + SUFFIX)


def _line(name: str, entry: WrittenFile) -> str:
    return json.dumps([name, *entry]) + "\n"


def _rewrite(folder: Path, entries: dict[str, WrittenFile]) -> None:
    """Replace a record by one without the lines that newer ones made void."""
    with suppress(OSError, RuntimeError):
        record = _record_path(folder)
        with scratch_folder(record.parent) as scratch:
            new = scratch / record.name
            new.write_text("".join(_line(*item) for item in entries.items()), encoding="ascii")
            new.replace(record)


def _forget_oldest(records: Path) -> None:
    """Remove the records that were not written to for longest, so that one more has room."""
    by_age = sorted(records.glob(f"*{SUFFIX}"), key=lambda path: path.stat().st_mtime)
    for path in by_age[: max(0, len(by_age) - MOST_RECORDS + 1)]:
        path.unlink(missing_ok=True)
