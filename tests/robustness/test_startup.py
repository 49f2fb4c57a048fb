"""Commands answer at once: what is heavy is loaded when there is work for it, not to show a help text."""

import subprocess
import sys

import pytest
from idesplat.runtime.cli.application import COMMANDS

HEAVY = {"cv2", "numba", "onnx", "onnxruntime", "scipy", "torch", "trimesh"}
HELP = {  # the arguments, and what must not be loaded besides
    "": {"numpy", "rich.progress"},
    **{name: set() for name in COMMANDS},
    "infer": {"numpy"},
    "cameras convert": set(),
    "eval scene": set(),
}


def loaded_by(program: str, *arguments: str) -> tuple[set[str], str]:
    """The modules that a program has loaded when it ends, and what it printed."""
    ended = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
    command = [sys.executable, "-c", ended + program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.split()), done.stdout


@pytest.mark.parametrize("words", HELP)
def test_help_loads_nothing_heavy(words: str) -> None:
    program = "from idesplat.runtime.cli.launch import idesplat; idesplat()"
    modules, printed = loaded_by(program, *words.split(), "--help")
    assert "Usage" in printed
    assert not modules & (HEAVY | HELP[words])


@pytest.mark.parametrize("program", ["import idesplat", "import idesplat.runtime; from idesplat import InputError"])
def test_the_package_loads_nothing_heavy(program: str) -> None:
    modules, _ = loaded_by(program)
    assert "idesplat.runtime.startup" in modules
    assert not modules & (HEAVY | {"numpy", "typer"})
