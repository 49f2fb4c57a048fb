"""The repository's layout: boundaries between packages, no circles of imports, and every package in the wheel."""

import ast
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("model", "export", "runtime", "tools")
FORBIDDEN = {
    "model": {"export", "runtime", "tools", "onnx", "onnxruntime", "cv2"},
    "export": {"tools"},
    "runtime": {"model", "export", "tools", "torch", "onnx", "onnxscript"},
    "tools": set(),
}
# A package imports only what stands before it.
ORDERS = {
    "runtime": (
        *("errors", "system", "startup", "geometry", "images", "cameras", "sfm", "views", "splats", "inference"),
        *("rendering", "refinement", "viewer", "web", "reconstruction", "batch", "service", "cli"),
    ),
    "model": ("config", "common", "family", "idesplat", "depthsplat", "registry", "checkpoint"),
    "export": (
        *("existing_exports", "targets", "graph", "stages", "example_inputs", "precision", "tracing", "validation"),
        *("conversion", "calibration_images", "hub", "triton", "pipeline", "released", "cli"),
    ),
    "tools": ("processes", "imagenet", "perceptual", "synthetic", "evaluation", "training", "benchmark", "figures"),
}

# Modules that import others of ours inside functions: commands, for their start-up time, and these.
LAZY = {
    "export.pipeline": "PyTorch and onnx are optional",
    "export.released.pull": "PyTorch is optional",
    "runtime.rendering.rasterizer": "numba takes time to load",
    "tools.benchmark.components": "PyTorch is optional",
    "tools.benchmark.runner": "PyTorch is optional",
    "tools.benchmark.training": "PyTorch is optional",
    "tools.benchmark.worker": "measures what each import costs its process",
    "tools.evaluation.cases": "numba takes time to load, and is needed for synthetic scenes alone",
    "tools.evaluation.chunks": "PyTorch is optional",
    "tools.evaluation.evaluate": "numba takes time to load, and is needed for synthetic scenes alone",
    "tools.evaluation.metrics": "PyTorch is optional, and needed for perceptual distances alone",
    "tools.synthetic.make_scene": "a command",
}


def modules() -> dict[str, Path]:
    """Every module by its name below `idesplat`, such as `runtime.cameras.camera`."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(name: str, path: Path, known: dict[str, Path]) -> Iterator[str]:
    """The modules that one imports, also inside functions: ours by their name, others by their top level."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in _without_type_checking(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node, name, path.name == "__init__.py")
            if base is None:
                yield str(node.module).partition(".")[0]
                continue
            for alias in node.names:
                full = f"{base}.{alias.name}".lstrip(".")
                yield full if full in known else base


def _without_type_checking(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from _without_type_checking(node)


def _absolute(node: ast.ImportFrom, name: str, is_package: bool) -> str | None:
    """The module that `from ... import` names, below `idesplat`; None for a module of somebody else."""
    if node.level == 0:
        module = node.module or ""
        return module.removeprefix("idesplat").lstrip(".") if module.partition(".")[0] == "idesplat" else None
    parts = name.split(".")
    parts = parts[: len(parts) - node.level + is_package]
    return ".".join([*parts, *([node.module] if node.module else [])])


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    """What each of our modules imports, itself left out."""
    known = modules()
    return {name: set(imports(name, path, known)) - {name} for name, path in known.items()}


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_keep_their_boundaries(graph: dict[str, set[str]], package: str) -> None:
    for name, imported in graph.items():
        if name.partition(".")[0] == package:
            tops = {module.partition(".")[0] for module in imported}
            assert not tops & FORBIDDEN[package], name


def test_no_circles_of_imports(graph: dict[str, set[str]]) -> None:
    ours = {name: {module for module in imported if module in graph} for name, imported in graph.items()}
    try:
        TopologicalSorter(ours).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


@pytest.mark.parametrize("package", ORDERS)
def test_packages_import_only_what_stands_before_them(graph: dict[str, set[str]], package: str) -> None:
    rank = {name: index for index, name in enumerate(ORDERS[package])}
    for name, imported in graph.items():
        if not name.startswith(f"{package}."):
            continue
        own = name.split(".")[1]
        assert own in rank, f"{name}: not in the order of {package}"
        for module in imported:
            if module.startswith(f"{package}."):
                assert rank[module.split(".")[1]] <= rank[own], f"{name} imports {module}"


def test_imports_inside_functions_are_for_start_up_time_or_optional_dependencies() -> None:
    known = modules()
    found = set()
    for name, path in known.items():
        functions = (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if _is_function(node))
        inside = (node for function in functions for node in ast.walk(function) if isinstance(node, ast.ImportFrom))
        if any(_absolute(node, name, path.name == "__init__.py") is not None for node in inside):
            found.add(name)
    assert {name for name in found if not _is_command(name)} == set(LAZY)


def _is_function(node: ast.AST) -> bool:
    return isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))


def _is_command(name: str) -> bool:
    return name.startswith("runtime.cli.") or name.endswith(".cli")


def test_libraries_do_not_depend_on_commands(graph: dict[str, set[str]]) -> None:
    """Reports of commands print, and scripts are commands."""
    known = modules()
    for name, imported in graph.items():
        is_script = 'if __name__ == "__main__"' in known[name].read_text(encoding="utf-8")
        if not (_is_command(name) or name.endswith(".report") or is_script):
            assert not {module for module in imported if module.startswith("runtime.cli")}, name


def test_every_package_is_in_the_wheel() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for package in PACKAGES for path in (ROOT / package).rglob("__init__.py")}
    expected = {"idesplat", *(".".join(["idesplat", *folder.relative_to(ROOT).parts]) for folder in folders)}
    assert set(settings["packages"]) == expected
    assert settings["package-dir"] == {"idesplat": "."}
    with_code = {path.parent for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    assert with_code == folders  # a folder without __init__.py would be missed


# Training goes on from it in a checkout; an installation has no use for it.
NOT_IN_THE_WHEEL = {"idesplat/tools/training/bundled.safetensors"}


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_data_file(tmp_path: Path) -> None:
    """Built from a copy, since setuptools leaves files beside the sources, with the setuptools that is installed."""
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns("__pycache__")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=ignored)
    for path in (*ROOT.glob("*.py"), *(ROOT / name for name in ("py.typed", "pyproject.toml", "README.md"))):
        shutil.copy(path, source)
    for name in ("LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=source, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        wheel_files = {name for name in archive.namelist() if name.startswith("idesplat/")}
    sources = (path for package in PACKAGES for path in (source / package).rglob("*") if path.is_file())
    expected = {f"idesplat/{path.relative_to(source).as_posix()}" for path in (*sources, *source.glob("*.py"))}
    assert expected >= NOT_IN_THE_WHEEL
    assert wheel_files == expected - NOT_IN_THE_WHEEL | {"idesplat/py.typed"}


def test_nothing_generic_becomes_importable(tmp_path: Path) -> None:
    code = "import importlib.util as u; assert not any(u.find_spec(n) for n in ('model', 'export', 'runtime', 'tools'))"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, timeout=60)


def test_the_citation_names_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_test_files_have_names_of_their_own() -> None:
    """pytest imports test files by their file name alone; a second one of the same name is not collected."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py") if "node_modules" not in path.parts]
    assert sorted(names) == sorted(set(names))
