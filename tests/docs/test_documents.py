"""Every command, option, module and path that the documents name exists, and the site builds without a warning."""

import importlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from idesplat.runtime.cli.application import app

ROOT = Path(__file__).parents[2]
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
# Sections about names that no longer exist.
HISTORY = {"CHANGELOG.md"}
# Files that the pages about tasks tell the reader to write, and a file of another project.
TO_BE_WRITTEN = {
    "runtime/cameras/formats/middlebury.py",
    "tests/runtime/cameras/test_middlebury.py",
    "model/mono/__init__.py",
    "model/mono/family.py",
    "tests/model/test_mono.py",
    "tests/runtime/views/test_selection_distance.py",
    "docs/nerfology/methods/splat.md",
}
TO_BE_WRITTEN_MODULES = {"idesplat.model.mono"}
OLD_COMMANDS = ("idesplat-infer", "idesplat-export")  # other names of sub-commands
CODE = re.compile(r"```[^\n]*\n(.*?)```|`([^`\n]+)`", re.DOTALL)
INDENTED = re.compile(r"^    (\S(?:.*\\\n)*.*)", re.MULTILINE)
MODULE = re.compile(r"\bidesplat(?!\.js\b)(?:\.[A-Za-z_]\w*)+")  # idesplat.js is a file of the page
PLACES = r"(?:runtime|model|export|tools|tests|docs)"
REPOSITORY_PATH = re.compile(rf"^{PLACES}/[\w./-]+$")


def name_of(document: Path) -> str:
    return str(document.relative_to(ROOT))


def snippets(document: Path) -> Iterator[str]:
    """Everything set as code in a document."""
    text = document.read_text(encoding="utf-8")
    yield from (block or inline for block, inline in CODE.findall(text))
    yield from INDENTED.findall(text)


def command_lines(document: Path) -> Iterator[list[str]]:
    """The words of every line that calls `idesplat`."""
    for snippet in snippets(document):
        for line in snippet.replace("\\\n", " ").splitlines():
            line = line.strip().removeprefix(".venv/bin/")
            words = shlex.split(line, comments=True) if line.startswith("idesplat") else []
            if words and words[0] in OLD_COMMANDS:
                words[:1] = words[0].split("-")
            if words and words[0] == "idesplat":
                yield words


def command(words: list[str]) -> tuple[Any, str, list[str]]:
    """The command that a line names, its name, and the words that are left for it."""
    found, name, rest = typer.main.get_command(app), words[0], words[1:]
    with found.make_context(name, [], resilient_parsing=True) as context:
        while rest and hasattr(found, "list_commands") and not rest[0].startswith("-"):
            listed = found.list_commands(context)
            assert rest[0] in listed, f"{shlex.join(words)}: {rest[0]} is none of {listed}"
            resolved, found, left = found.resolve_command(context, rest)
            name, rest = f"{name} {resolved}", left
    return found, name, rest


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d.name not in HISTORY], ids=name_of)
def test_commands_and_options_exist(document: Path) -> None:
    for words in command_lines(document):
        found, name, rest = command(words)
        options = {option for parameter in found.params for option in (*parameter.opts, *parameter.secondary_opts)}
        options |= {"--help", "-h", "--version"}
        for word in rest:
            option = word.strip("[],").partition("=")[0]
            assert not option.startswith("-") or option == "-" or option in options, f"{shlex.join(words)}: {name}"


def test_a_wrong_command_and_a_wrong_option_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```\nidesplat infer photos --no-such-option 3\n```\n")
    with pytest.raises(AssertionError, match="no-such-option"):
        test_commands_and_options_exist(page)
    page.write_text("Call `idesplat draw scene.ply`.\n")
    with pytest.raises(AssertionError, match="draw"):
        test_commands_and_options_exist(page)


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d.name not in HISTORY], ids=name_of)
def test_modules_and_functions_exist(document: Path) -> None:
    for dotted in set(MODULE.findall(document.read_text(encoding="utf-8"))):
        if dotted not in TO_BE_WRITTEN_MODULES and not dotted.endswith((".ckpt", ".onnx", ".json")):
            resolve(dotted)


def resolve(dotted: str) -> object:
    """The module, class or function of a name such as `idesplat.runtime.cameras.camera.Camera`."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            found = getattr(found, part)
        return found
    raise AssertionError(dotted)


def test_a_wrong_name_is_found() -> None:
    with pytest.raises(AttributeError):
        resolve("idesplat.runtime.no_such_module")


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d.name not in HISTORY], ids=name_of)
def test_paths_exist(document: Path) -> None:
    for snippet in snippets(document):
        for word in snippet.split():
            path = word.strip("`(),;:").rstrip(".")
            if REPOSITORY_PATH.match(path) and path not in TO_BE_WRITTEN:
                assert (ROOT / path).exists(), path


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d.parent == ROOT], ids=name_of)
def test_links_lead_somewhere(document: Path) -> None:
    """Of the documents outside of the site; MkDocs checks the links of its own pages."""
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text(encoding="utf-8")):
        if not re.match(r"https?:|mailto:|#", target):
            assert (ROOT / target.partition("#")[0]).exists(), target


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_loads_nothing_from_other_hosts(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    site = tmp_path / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="?(https?:)?//', text)
        loaded += re.findall(r'<link[^>]*rel="?(?:stylesheet|preconnect|preload)"?[^>]*href="?(https?:)?//', text)
        assert not loaded, page
    assert "--max-depth-jump" in (site / "commands.html").read_text(encoding="utf-8")
