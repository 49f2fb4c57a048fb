"""The one folder outside of a command's own outputs that idesplat writes to."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """The folder of this name within ours in the user's cache folder; it may not exist, and may be deleted.

    Raises RuntimeError where the user has no home folder.
    """
    given = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(given) if given else Path.home() / ".cache") / "idesplat" / name
