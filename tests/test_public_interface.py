"""`import idesplat`: public names with their signatures, typed, also from a wheel."""

import importlib
import inspect
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import idesplat
import pytest
from idesplat import runtime

ROOT = Path(__file__).parent.parent
NAMES = {
    *("reconstruct", "Reconstruction", "Predictor", "Runner", "Gaussians", "read_splats", "write_splats", "Camera"),
    *("read_cameras", "write_cameras", "estimate_cameras", "rasterize", "render", "evaluate", "bundled_model"),
    *("InputError", "__version__", "export_checkpoint"),
}


@pytest.mark.filterwarnings("ignore:Runner:DeprecationWarning")
def test_every_public_name_loads_and_is_documented():
    assert set(idesplat.__all__) >= NAMES
    assert set(idesplat.__all__) <= set(dir(idesplat))
    for name in set(idesplat.__all__) - {"__version__"}:
        assert inspect.getdoc(getattr(idesplat, name)), name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        idesplat.nothing  # noqa: B018


def test_version_is_the_project_s():
    assert idesplat.__version__ == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_names_for_type_checkers_are_those_that_load():
    """`TYPE_CHECKING` imports what `__getattr__` finds."""
    source = (ROOT / "__init__.py").read_text()
    for name, module in idesplat._MODULE_OF.items():
        line = next(line for line in source.splitlines() if line.startswith(f"    from .{module} import"))
        assert name in line.partition(" import ")[2].replace(",", "").split()


def test_old_names_are_kept_for_a_version():
    with pytest.warns(DeprecationWarning, match="Predictor"):
        assert idesplat.Runner is idesplat.Predictor
    with pytest.warns(DeprecationWarning, match="idesplat.read_splats"):
        assert runtime.read_scene is idesplat.read_splats


SIGNATURES = {
    "reconstruct": ["images", "cameras", "model", "select", "views", "size", "near", "far", "progress"],
    "evaluate": ["images", "cameras", "model"],
    "export_checkpoint": ["checkpoint", "out", "staged"],
    "estimate_cameras": ["focal"],
    "read_cameras": ["path"],
    "write_cameras": ["path", "cameras"],
    "read_splats": ["path"],
    "write_splats": ["path", "gaussians"],
    "render": ["gaussians", "cameras"],
    "rasterize": ["means", "quats", "scales", "opacities", "sh"],
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures(name):
    parameters = inspect.signature(getattr(idesplat, name)).parameters
    assert set(SIGNATURES[name]) <= set(parameters)
    assert all(parameter.annotation is not inspect.Parameter.empty for parameter in parameters.values())


@pytest.mark.slow
def test_a_wheel_has_types_and_the_public_names(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name in ("model", "export", "runtime", "tools"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for pattern in ("*.py", "*.md", "*.toml", "py.typed", "LICENSE", "NOTICE"):
        for file in ROOT.glob(pattern):
            shutil.copy(file, source)
    build = "from setuptools.build_meta import build_wheel; print(build_wheel('.'))"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next(source.glob("*.whl"))) as wheel:
        wheel.extractall(tmp_path / "installed")
    assert (tmp_path / "installed" / "idesplat" / "py.typed").is_file()
    code = "import idesplat; print(idesplat.__file__, idesplat.InputError.__mro__[1].__name__, idesplat.reconstruct)"
    environment = {"PYTHONPATH": str(tmp_path / "installed"), "PATH": "", "HOME": str(tmp_path)}
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert str(tmp_path / "installed") in ran.stdout and "ValueError" in ran.stdout, ran.stderr


def test_the_module_runs_as_the_command():
    module = importlib.import_module("idesplat.__main__")
    from idesplat.runtime.cli import launch

    assert module.idesplat is launch.idesplat
