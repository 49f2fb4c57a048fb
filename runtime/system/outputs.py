"""Registry of a run's inputs and outputs, which keeps files from being replaced by mistake.

An output is refused if the same run reads the file, if it is another output of the run, or if it exists and was not
written by one of our commands (`output_records`). The option --overwrite lifts only the last restriction.

Inside the context of `Outputs`, inputs and outputs are registered with `outputs()` as soon as they are known. Files
that `atomic_write` writes without registration are checked when they are written.
"""

import itertools
import os
import stat
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from ..errors import InputError
from .files import GUARD, check_writable, without_case
from .output_records import WrittenFile, add_to_record, is_unchanged, read_record


class Outputs:
    """The files that one run of a command reads and writes.

    command: its name, for the record of written files. overwrite: whether other existing files may be replaced.
    As a context manager it checks every write, and removes the empty folders that it created if the run fails.
    """

    def __init__(self, command: str, overwrite: bool = False) -> None:
        self.command, self.overwrite = command, overwrite
        self.stdout: TextIO = sys.stdout
        self._inputs: dict[object, tuple[Path, str]] = {}  # by identity: the path, and what it is
        self._outputs: dict[object, tuple[Path, str]] = {}  # by identity: the path, and its option
        self._folders: dict[object, str] = {}  # folders that hold outputs, and theirs: the option
        self._checked: set[Path] = set()  # folders that are known to hold outputs
        self._records: dict[Path, dict[str, WrittenFile]] = {}
        self._real_folders: dict[Path, str] = {}
        self._made: list[Path] = []
        self._contexts = ExitStack()

    def __enter__(self) -> Self:
        self._contexts.callback(GUARD.reset, GUARD.set(self))
        self._contexts.callback(_CURRENT.reset, _CURRENT.set(self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._contexts.close()
        if kind is not None:
            for folder in reversed(self._made):
                with suppress(OSError):  # it is not empty any more
                    folder.rmdir()

    def reads(self, what: str, paths: Iterable[Path]) -> None:
        """Register files that the run reads, and what they are, such as "an image"; they need not exist.

        Raises InputError if one of them is an output.
        """
        for path in paths:
            path = Path(path)
            for key in self._identities(path):
                if key in self._outputs:
                    self._refuse_input(*self._outputs[key], path, what)
                self._inputs.setdefault(key, (path, what))

    def writes(self, option: str, paths: Iterable[Path], known: bool = False) -> None:
        """Register files that the run will write, and the option that requests them.

        known: existing files belong to this run, as their content shows.
        Raises InputError, before anything is written, if one of them must not be written, or cannot be.
        """
        strangers = []
        for path in paths:
            path = Path(path)
            existing = _existing(option, path)
            keys = self._identities(path)
            for key in keys:
                if key in self._inputs:
                    self._refuse_input(path, option, *self._inputs[key])
            self._add(option, path, keys)
            if existing and not (known or self.overwrite) and self.writer_of(path) is None:
                strangers.append(path)
        if strangers:
            others = f" (and {len(strangers) - 1} more)" if len(strangers) > 1 else ""
            raise InputError(
                f"{_named(option)}{strangers[0]}{others}: exists, and idesplat did not write it, or it was changed "
                "since; choose another name, or add --overwrite to replace it"
            )

    def writes_into(self, option: str, folder: Path) -> None:
        """Register a folder for files whose names are not known yet; raises InputError if it cannot be created."""
        folder = Path(folder)
        with _refusing_bad_names(folder):
            if os.path.lexists(folder) and not folder.is_dir():
                raise InputError(f"{_named(option)}{folder}: is a file, expected a folder")
        self._add_folder(option, folder)

    def writer_of(self, path: Path) -> str | None:
        """The command that wrote a file, or None if no command did or the file was changed since."""
        folder = Path(path).parent
        if folder not in self._records:
            self._records[folder] = read_record(folder)
        entry = self._records[folder].get(Path(path).name)
        return entry.command if entry is not None and is_unchanged(Path(path), entry) else None

    def check(self, path: Path) -> None:
        """Check a file that is about to be written, unless it was registered, and create its folder."""
        if self._comparable(path) not in self._outputs:
            self.writes("", [path])
        self.make_folder(Path(path).parent)

    def written(self, path: Path) -> None:
        """Record that the command has written a file."""
        add_to_record(Path(path), self.command)

    def make_folder(self, folder: Path) -> None:
        """Create a folder and its parents; they are removed again if the run fails before anything is in them."""
        missing = list(itertools.takewhile(lambda place: not place.exists(), (folder, *folder.parents)))
        for place in reversed(missing):
            try:
                place.mkdir(exist_ok=True)
            except OSError as error:
                raise InputError(f"cannot create the folder {place}: {error.strerror}; choose another") from None
            self._made.append(place)

    def _add(self, option: str, path: Path, keys: Sequence[object]) -> None:
        """Add an output that is not an input; raises InputError if it conflicts with another output."""
        comparable = self._comparable(path)
        for key in (comparable, *keys):
            if key in self._outputs:
                raise InputError(f"{_named(option)}{path}: is also the file of {self._outputs[key][1]}; choose another")
        if comparable in self._folders:
            raise InputError(f"{_named(option)}{path}: is also a folder of {self._folders[comparable]}; choose another")
        self._add_folder(option, path.parent)
        for key in (comparable, *keys):
            self._outputs[key] = path, option or str(path)

    def _add_folder(self, option: str, folder: Path) -> None:
        """Add a folder of outputs; raises InputError if it cannot be created or an output has its path."""
        if folder in self._checked:
            return
        for place in (folder, *folder.parents):
            key = self._comparable(place)
            if key in self._outputs:
                other = self._outputs[key][1]
                raise InputError(f"{_named(option)}{folder}: {place} is the file of {other}; choose another")
            self._folders.setdefault(key, option or str(folder))
        check_can_create(folder)
        self._checked.add(folder)

    def _comparable(self, path: Path) -> object:
        """The key under which two outputs are the same, on whatever file system."""
        return "output", without_case(self._real(path))

    def _identities(self, path: Path) -> list[object]:
        """Keys that identify a path: the resolved path and, for an existing file, its device and inode."""
        keys: list[object] = [self._real(path)]
        with _refusing_bad_names(path), suppress(OSError):
            status = os.stat(path)
            keys.append((status.st_dev, status.st_ino))
        return keys

    def _real(self, path: Path) -> str:
        """The resolved path; folders are resolved once and cached."""
        with _refusing_bad_names(path):
            if path.name in ("", "..") or os.path.islink(path):
                return os.path.realpath(path)
            if path.parent not in self._real_folders:
                self._real_folders[path.parent] = os.path.realpath(path.parent)
            return os.path.join(self._real_folders[path.parent], path.name)

    def _refuse_input(self, path: Path, option: str, source: Path, what: str) -> None:
        raise InputError(f"{_named(option)}{path}: would replace {what}, {source}; choose another name")


_CURRENT: ContextVar[Outputs | None] = ContextVar("_CURRENT", default=None)


def outputs() -> Outputs:
    """The `Outputs` of the running command; outside of commands a new one without registered files."""
    return _CURRENT.get() or Outputs("idesplat")


def check_can_create(folder: Path) -> None:
    """Raise InputError unless files could be written into a folder, which may have to be made first."""
    place = Path(folder)
    with _refusing_bad_names(folder):
        while not os.path.lexists(place) and place != place.parent:
            place = place.parent
        if not place.is_dir():
            raise InputError(f"cannot write into {folder}: {place} is not a folder; choose another")
    check_writable(place)


def _existing(option: str, path: Path) -> bool:
    """Whether there is a file (or a link) of this name; raises InputError if there is something else."""
    with _refusing_bad_names(path):
        try:
            mode = path.lstat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise InputError(f"{_named(option)}{path}: cannot be written ({error.strerror}); choose another") from None
        with suppress(OSError):  # a dangling link is kept as it is
            mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise InputError(f"{_named(option)}{path}: is a folder, expected a file to write")
    if not stat.S_ISREG(mode) and not stat.S_ISLNK(mode):
        raise InputError(f"{_named(option)}{path}: is a device or a pipe, expected a file to write")
    return True


@contextmanager
def _refusing_bad_names(path: Path) -> Iterator[None]:
    """Raise InputError for a name that no file can have: with a NUL, or characters that cannot be encoded."""
    try:
        yield
    except InputError:
        raise
    except ValueError:
        raise InputError(f"{str(path)!a}: no file can have this name; choose another") from None


def _named(option: str) -> str:
    return f"{option} " if option else ""
