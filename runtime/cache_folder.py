"""Where everything is kept from one run to the next: one folder of ours in the user's cache folder."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """The folder, which need not exist yet; raises RuntimeError where the user has no home folder."""
    given = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(given) if given else Path.home() / ".cache") / "idesplat"
