"""The cache folder: the only place that idesplat writes to besides the outputs of a command."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """The subfolder `name` of idesplat's cache folder; it need not exist, and may be deleted at any time.

    Raises RuntimeError if the user has no home folder.
    """
    given = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(given) if given else Path.home() / ".cache") / "idesplat" / name
