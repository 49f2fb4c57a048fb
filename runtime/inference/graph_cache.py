"""Graphs as ONNX Runtime has optimised them, kept from one run and process to the next.

Optimising a graph of thousands of nodes takes several times longer than loading what comes of it. What comes of it
depends on the processor, so an entry's name says for what it was made, and proves its content: a file that is damaged,
renamed or made elsewhere is never used. The cache lies in the user's cache folder and may be deleted at any time.
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

LAYOUT = 1
SUFFIX = ".onnx"
KEY_LENGTH = 32  # hexadecimal digits
# A larger model runs for so long that a second or two of optimising it do not matter, and would crowd out the others.
LARGEST_MODEL = 256 << 20  # bytes
LARGEST_CACHE = 1 << 30  # bytes; what was not used for longest goes first
# How a tensor in ONNX's format says that its values are in another file: the key "location" of a property.
EXTERNAL = b"\n\x08location"
# In Linux's /proc/cpuinfo: names and instruction sets, on x86 and on ARM.
PROCESSOR_FIELDS = ("model name", "flags", "CPU part", "Features")

Result = TypeVar("Result")


@dataclass(frozen=True)
class CacheEntry:
    """Where one model's optimised graph is kept, for this processor and this ONNX Runtime."""

    folder: Path
    key: str

    def get(self) -> Path | None:
        """The optimised graph, if it is there and intact; what is there and is not, is removed."""
        for path in self.folder.glob(f"{self.key}.*{SUFFIX}"):
            with suppress(OSError):
                if _is_regular(path) and path.name == self._name(path):
                    _touch(path)
                    return path
                path.unlink()
        return None

    def put(self, make: Callable[[Path], Result]) -> Result:
        """Have `make` write the optimised graph to a path, keep it whole or not at all, and return what `make` does.

        Raises OSError where the folder cannot be written, and what `make` raises.
        """
        with scratch_folder(self.folder) as scratch:
            temporary = scratch / f"graph{SUFFIX}"
            result = make(temporary)
            path = temporary.replace(self.folder / self._name(temporary))
        _shrink(self.folder, path)
        return result

    def evict(self, path: Path) -> None:
        """Remove an entry that is intact and of no use."""
        with suppress(OSError):
            path.unlink()

    def _name(self, path: Path) -> str:
        """The name that an entry with the content of `path` has here and nowhere else."""
        digest = hashlib.sha256(self.key.encode())
        with open_regular(path) as file:
            digest.update(file.read())
        return f"{self.key}.{digest.hexdigest()}{SUFFIX}"


def cache_entry(model: Path) -> CacheEntry | None:
    """Where the optimised graph of a model file belongs; None where it is not to be, or cannot be, kept."""
    try:
        if not _is_regular(model) or model.stat().st_size > LARGEST_MODEL:
            return None
        content = model.read_bytes()
        if EXTERNAL in content:  # those files' content would have to be part of the key
            return None
        folder = cache_folder("graphs")
        folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned_folders(folder)
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return None
    made_for = [LAYOUT, onnxruntime.__version__, onnxruntime.get_build_info(), _processor()]
    digest = hashlib.sha256(json.dumps(made_for).encode())
    digest.update(content)
    return CacheEntry(folder, digest.hexdigest()[:KEY_LENGTH])


def _is_regular(path: Path) -> bool:
    """Whether it can be read to its end: a named pipe cannot."""
    return stat.S_ISREG(path.stat().st_mode)


def _processor() -> str:
    """What tells processors apart: where the system does not say it in full, this machine's name as well."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return " ".join(platform.uname())
    return "\n".join(sorted({line for line in lines if line.startswith(PROCESSOR_FIELDS)}))


def _touch(path: Path) -> None:
    """Note that a file was used just now, where its folder can be written."""
    with suppress(OSError):
        os.utime(path)


def _shrink(folder: Path, newest: Path) -> None:
    """Remove what was not used for longest until the cache has room again, but never the newest."""
    with suppress(OSError):  # another process may be at it, too
        entries = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in folder.glob(f"*{SUFFIX}"))
        size = sum(entry[1] for entry in entries)
        for _, bytes_, path in entries:
            if size > LARGEST_CACHE and path != newest:
                path.unlink()
                size -= bytes_
