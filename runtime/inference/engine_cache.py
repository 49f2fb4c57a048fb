"""A folder for the engines that an execution provider compiles from a graph, one for everything they depend on.

Compiling takes seconds to minutes. What comes out depends on the graph, the versions of ONNX Runtime and the provider,
the device and the options, so the folder's name is a hash of all of them: after an update, another folder is used.
The folders are in the user's cache and may be deleted at any time.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import onnxruntime

from ..system.cache_folder import cache_folder
from .graph_cache import KEY_LENGTH, describe_cpu
from .model_files import external_files
from .providers import Provider

LAYOUT = 1
MAX_CACHE_BYTES = 8 << 30  # the least recently used folders are removed first


def engine_folder(model: Path, provider: Provider, device: str, options: Mapping[str, str]) -> Path | None:
    """The folder for the engines of a graph, created; None where the cache cannot be used.

    device: describes the device and its driver, as far as is known. options: those that the user gave.
    """
    made_for: list[object] = [LAYOUT, onnxruntime.__version__, onnxruntime.get_build_info(), describe_cpu()]
    made_for += [provider.ep_name, provider.version, device, sorted(options.items())]
    digest = hashlib.sha256(json.dumps(made_for).encode())
    try:
        for path in (model, *external_files(model)):
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        root = cache_folder("engines")
        folder = root / f"{provider.name}-{digest.hexdigest()[:KEY_LENGTH]}"
        folder.mkdir(parents=True, exist_ok=True)
        folder.touch()
    except (OSError, RuntimeError):  # RuntimeError: there is no home folder
        return None
    _shrink(root, folder)
    return folder


def _shrink(root: Path, newest: Path) -> None:
    """Remove the least recently used folders until the cache fits its limit, but never the newest."""
    with suppress(OSError):  # another process may do the same
        folders = sorted((path.stat().st_mtime, path) for path in root.iterdir())
        sizes = {path: sum(file.stat().st_size for file in path.rglob("*")) for _, path in folders}
        total = sum(sizes.values())
        for _, path in folders:
            if total > MAX_CACHE_BYTES and path != newest:
                shutil.rmtree(path, ignore_errors=True)
                total -= sizes[path]
