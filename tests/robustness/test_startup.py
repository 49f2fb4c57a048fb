"""Commands answer at once: what is heavy is loaded when there is work for it, not to show a help text."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

SCRIPTS = tomllib.loads((Path(__file__).parent.parent.parent / "pyproject.toml").read_text())["project"]["scripts"]
HEAVY = {"cv2", "numba", "onnx", "onnxruntime", "scipy", "torch", "trimesh"}


@pytest.mark.parametrize("command", SCRIPTS)
def test_help_loads_nothing_heavy(command):
    module, _, function = SCRIPTS[command].partition(":")
    forbidden = HEAVY | ({"numpy"} if command == "idesplat-infer" else set())
    program = (
        f"import sys; from {module} import {function}\n"
        f"try: {function}()\n"
        "except SystemExit as stop: assert not stop.code\n"
        f"loaded = {forbidden} & set(sys.modules)\n"
        "assert not loaded, loaded"
    )
    done = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout
