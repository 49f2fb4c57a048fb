"""Files that several test processes use: the first process to need them makes them, the others wait for it."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def build_once(factory: pytest.TempPathFactory, name: str, build: Callable[[Path], object]) -> Path:
    """A folder that `build` filled once in this run of the tests, in whichever of pytest-xdist's processes it was.

    Tests only read it: files are made for all of them.
    """
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # of all processes
    folder, built = root / f"shared-{name}", root / f"shared-{name}.built"
    with FileLock(root / f"shared-{name}.lock"):
        if not built.exists():
            folder.mkdir(exist_ok=True)
            build(folder)
            built.touch()
    return folder
