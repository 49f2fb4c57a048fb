"""Models by name: the bundled one, and released ones that `idesplat pull` has exported into the cache."""

import os
from pathlib import Path

from ..errors import InputError
from ..system.cache_folder import cache_folder
from .bundled_model import NAME as BUNDLED_FILE
from .bundled_model import bundled_model
from .known_models import KNOWN_MODELS

SUFFIX = ".onnx"
BUNDLED = BUNDLED_FILE.removesuffix(SUFFIX)


def find_model(model: Path | str | None = None) -> Path:
    """The path of a model that is given as a path or by name; of the bundled one where none is given.

    A file or folder of that name goes before the name. Raises InputError for a name that is not known, with the names
    that are, and for a released model that is not in the cache; a path need not exist.
    """
    if model is None:
        return bundled_model()
    path, name = Path(model), str(model)
    if path.suffix == SUFFIX or os.sep in name or "/" in name or path.exists():
        return path
    if name == BUNDLED:
        return bundled_model()
    if name not in KNOWN_MODELS:
        names = ", ".join((BUNDLED, *KNOWN_MODELS))
        raise InputError(
            f"{name}: no such model; give a .onnx file or staged folder made by idesplat export, or one of {names}"
        )
    cached = cached_path(name)
    if not cached.is_file():
        raise InputError(f"{name}: is not in the cache yet; `idesplat pull {name}` downloads and exports it")
    return cached


def cached_path(name: str) -> Path:
    """Where the graph of a released model is kept; it need not exist. Raises InputError without a home folder."""
    try:
        return cache_folder("models") / f"{name}{SUFFIX}"
    except RuntimeError as error:
        raise InputError(f"there is no folder for models ({error}); set XDG_CACHE_HOME to one") from None
