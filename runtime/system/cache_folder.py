"""The cache folder: the only place that idesplat writes to besides the outputs of a command."""

import os
from pathlib import Path

from platformdirs import user_cache_path


def cache_folder(name: str) -> Path:
    """The subfolder `name` of idesplat's cache folder; it need not exist, and may be deleted at any time.

    The cache folder is the system's for one user's programs, or `idesplat` in $XDG_CACHE_HOME, on every system.
    Raises RuntimeError if the user has no home folder.
    """
    given = os.environ.get("XDG_CACHE_HOME")
    folder = Path(given) / "idesplat" if given else user_cache_path("idesplat", appauthor=False)
    if not given and not folder.is_absolute():  # ~ was not expanded
        raise RuntimeError("the user has no home folder")
    return folder / name
