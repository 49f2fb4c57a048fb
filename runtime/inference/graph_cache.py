"""A cache of the graphs that ONNX Runtime has optimised, shared by processes.

Optimising a graph of thousands of nodes takes several times longer than loading the result. The result depends on the
CPU, so an entry's name contains a hash of what it was made for and one of its content: a file that is damaged, renamed
or made on another machine is not used. The cache is in the user's cache folder and may be deleted at any time.
"""

import hashlib
import json
import os
import platform
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import onnxruntime

from ..system.cache_folder import cache_folder
from ..system.files import open_regular, remove_abandoned_folders, scratch_folder

# Counts up with how entries are named, and with the session options that change what ONNX Runtime optimises.
LAYOUT = 2
SUFFIX = ".onnx"
KEY_LENGTH = 32  # hexadecimal digits
# Larger models run so long that a second or two of optimisation do not matter, and would displace others.
MAX_MODEL_BYTES = 256 << 20
MAX_CACHE_BYTES = 1 << 30  # the least recently used entries are removed first
# In a TensorProto whose values are in another file: the key "location" of its external_data.
EXTERNAL = b"\n\x08location"
# Lines of Linux's /proc/cpuinfo with names and instruction sets, on x86 and ARM.
CPU_FIELDS = ("model name", "flags", "CPU part", "Features")

Result = TypeVar("Result")


@dataclass(frozen=True)
class CacheEntry:
    """The cache entry of one model on this CPU with this version of ONNX Runtime."""

    folder: Path
    key: str

    def get(self) -> Path | None:
        """Path of the optimised graph, None if there is none; a damaged one is removed."""
        for path in self.folder.glob(f"{self.key}.*{SUFFIX}"):
            with suppress(OSError):
                if _is_regular(path) and path.name == self._name(path):
                    _touch(path)
                    return path
                path.unlink()
        return None

    def put(self, make: Callable[[Path], Result]) -> Result:
        """Call `make` with a path to write the optimised graph to, store it atomically, and return what `make` returns.

        Raises OSError if the folder cannot be written, and whatever `make` raises.
        """
        with scratch_folder(self.folder) as scratch:
            temporary = scratch / f"graph{SUFFIX}"
            result = make(temporary)
            path = temporary.replace(self.folder / self._name(temporary))
        _shrink(self.folder, path)
        return result

    def evict(self, path: Path) -> None:
        """Remove a graph that ONNX Runtime cannot use."""
        with suppress(OSError):
            path.unlink()

    def _name(self, path: Path) -> str:
        """The file name of an entry with the content of `path`: the key and a hash of key and content."""
        digest = hashlib.sha256(self.key.encode())
        with open_regular(path) as file:
            digest.update(file.read())
        return f"{self.key}.{digest.hexdigest()}{SUFFIX}"


def cache_entry(model: Path) -> CacheEntry | None:
    """The cache entry of a model file; None for a model that is not cached, or without a usable cache folder."""
    try:
        if not _is_regular(model) or model.stat().st_size > MAX_MODEL_BYTES:
            return None
        content = model.read_bytes()
        if EXTERNAL in content:  # those files' content would have to be part of the key
            return None
        folder = cache_folder("graphs")
        folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned_folders(folder)
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return None
    made_for = [LAYOUT, onnxruntime.__version__, onnxruntime.get_build_info(), describe_cpu()]
    digest = hashlib.sha256(json.dumps(made_for).encode())
    digest.update(content)
    return CacheEntry(folder, digest.hexdigest()[:KEY_LENGTH])


def _is_regular(path: Path) -> bool:
    """Whether it is a regular file, not a named pipe or device."""
    return stat.S_ISREG(path.stat().st_mode)


def describe_cpu() -> str:
    """A description of the CPU's type; without /proc/cpuinfo it includes the machine's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return " ".join(platform.uname())
    return "\n".join(sorted({line for line in lines if line.startswith(CPU_FIELDS)}))


def _touch(path: Path) -> None:
    """Set a file's time to now, if its folder can be written."""
    with suppress(OSError):
        os.utime(path)


def _shrink(folder: Path, newest: Path) -> None:
    """Remove the least recently used entries until the cache fits its limit, but never the newest."""
    with suppress(OSError):  # another process may do the same
        entries = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in folder.glob(f"*{SUFFIX}"))
        size = sum(entry[1] for entry in entries)
        for _, bytes_, path in entries:
            if size > MAX_CACHE_BYTES and path != newest:
                path.unlink()
                size -= bytes_
