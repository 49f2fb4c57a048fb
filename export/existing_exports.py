"""Existing exports: how graphs and staged folders of idesplat-export are recognised, and replaced atomically.

A staged folder is exchanged with the new one in one step where the system supports that. Elsewhere the old folder is
moved aside first; if a run is killed between the two steps, the next one restores it (`working_folder`).
"""

import ctypes
import json
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import onnx
from onnx.external_data_helper import ExternalDataInfo

from ..runtime.errors import InputError
from ..runtime.inference.metadata import MANIFEST_NAME, METADATA_KEY

# The manifest's field "format" of a staged folder, as `write_manifest` writes it.
STAGED_FORMAT = "idesplat-staged"
LARGEST_MANIFEST = 1 << 20  # bytes
LARGEST_GRAPH = 1 << 31  # bytes; Protobuf reads no larger message
# Working folders, beside their results. The process holds a lock on the file.
WORKING_PREFIX, LOCK = ".idesplat-export.", "lock"
# In a working folder: prefix of the folder that a new one replaced; its name follows.
PREVIOUS = "previous."
# Of Linux's renameat2 and of macOS's renamex_np.
RENAME_EXCHANGE, RENAME_SWAP, AT_FDCWD = 2, 2, -100


def is_our_graph(path: Path) -> bool:
    """Whether a regular file is an ONNX graph that idesplat exported, by its metadata."""
    graph = _read_graph(path)
    return graph is not None and any(entry.key == METADATA_KEY for entry in graph.metadata_props)


def weights_beside(path: Path) -> set[str]:
    """The names of the files in its folder that a graph keeps weights in; none if there is no graph."""
    graph = _read_graph(path)
    tensors = graph.graph.initializer if graph is not None else ()
    outside = (tensor for tensor in tensors if tensor.data_location == onnx.TensorProto.EXTERNAL)
    names = {ExternalDataInfo(tensor).location for tensor in outside}
    return {name for name in names if Path(name).name == name}


def foreign_entries(folder: Path) -> list[str]:
    """The entries of a folder that are no part of a staged export: all but its manifest, graphs and weights.

    All entries, if the manifest is not one of `idesplat-export --staged`.
    """
    own = {MANIFEST_NAME, *_staged_files(folder)}
    own |= {name for file in own for name in weights_beside(folder / file)}
    named = sorted(entry.name for entry in folder.iterdir())
    return [name for name in named if len(own) == 1 or name not in own or not _is_regular(folder / name)]


def replace_folder(new: Path, folder: Path) -> None:
    """Move a new folder to where a staged, an empty or no folder is; what was there is moved to the working folder.

    new: in a working folder beside it. Raises InputError, with the old folder in its place, if that holds anything that
    is no part of a staged export.
    """
    try:
        if not folder.exists() or not any(folder.iterdir()):
            new.rename(folder)  # which replaces an empty folder
            return
        _check_replaceable(folder, folder)
        if _exchange(new, folder):
            _check_replaceable(new, folder, undo=lambda: _exchange(new, folder))
            return
        previous = new.with_name(f"{PREVIOUS}{folder.name}")
        folder.rename(previous)
        _check_replaceable(previous, folder, undo=lambda: previous.rename(folder))
        new.rename(folder)
    except OSError as error:
        raise InputError(f"cannot write {folder}: {error.strerror}; choose another folder") from None


def check_replaceable(folder: Path) -> None:
    """Raise InputError if a folder holds anything that is no part of a staged export."""
    _check_replaceable(folder, folder)


def _check_replaceable(at: Path, folder: Path, undo: Callable[[], object] = lambda: None) -> None:
    """Raise InputError, after `undo`, if a folder's old content, which is now at `at`, must be kept."""
    foreign = foreign_entries(at)
    if foreign:
        undo()
        raise InputError(
            f"--staged {folder}: holds {foreign[0]}, which idesplat-export --staged did not write; "
            "choose an empty or new folder"
        )


@contextmanager
def working_folder(parent: Path) -> Iterator[Path]:
    """A working folder, beside the results; it is removed afterwards, and so are those of killed runs."""
    with suppress(OSError):
        _clean_up(parent)
    temporary = tempfile.TemporaryDirectory(prefix=WORKING_PREFIX, dir=parent, ignore_cleanup_errors=True)
    with temporary as name, _locked(Path(name)):
        yield Path(name)


def _clean_up(parent: Path) -> None:
    """Remove the working folders of killed runs, and restore a folder that one of them had moved aside."""
    for left in parent.glob(f"{WORKING_PREFIX}*"):
        lock = _lock(left / LOCK, os.O_RDWR)
        if lock is None:
            continue
        try:
            for old in left.glob(f"{PREVIOUS}*"):
                place = parent / old.name.removeprefix(PREVIOUS)
                if not place.exists():
                    old.rename(place)
            shutil.rmtree(left, ignore_errors=True)
        finally:
            os.close(lock)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a working folder; the lock file appears only once it is locked."""
    unnamed = folder / f"{LOCK}.new"
    lock = _lock(unnamed, os.O_RDWR | os.O_CREAT)
    unnamed.rename(folder / LOCK)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _lock(path: Path, flags: int) -> int | None:
    """A descriptor that holds the lock of a file; None where another process does, or there is no file or no lock."""
    try:
        import fcntl
    except ImportError:  # Windows: working folders of killed runs stay
        if flags & os.O_CREAT:
            path.touch()
        return None
    try:
        descriptor = os.open(path, flags | os.O_CLOEXEC, 0o600)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system or its file system cannot."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            return library.renamex_np(os.fsencode(one), os.fsencode(other), RENAME_SWAP) == 0
        exchanged = library.renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE)
        return exchanged == 0
    except (AttributeError, OSError, TypeError):  # no such function; Windows has no library without a name
        return False


def _staged_files(folder: Path) -> set[str]:
    """The graphs that the manifest of a staged folder names; none if it is not one of ours."""
    manifest = folder / MANIFEST_NAME
    if not _is_regular(manifest) or manifest.stat().st_size > LARGEST_MANIFEST:
        return set()
    try:
        content = json.loads(manifest.read_bytes())
        if content["format"] != STAGED_FORMAT:
            return set()
        names = {stage["file"] for stage in content["stages"]}
        return {name for name in names if is_our_graph(folder / name)}
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return set()


def _is_regular(path: Path) -> bool:
    """Whether there is a regular file, and not a link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def _read_graph(path: Path) -> onnx.ModelProto | None:
    """A graph without the weights beside it; None if there is none."""
    if not _is_regular(path) or path.stat().st_size > LARGEST_GRAPH:
        return None
    try:
        return onnx.load(path, load_external_data=False)
    except Exception:  # Protobuf's own error, which onnx does not name
        return None
