"""Whatever a command is given, it succeeds, or prints one line and changes nothing. See docs/security.md."""

import inspect
import json
import shutil
import tempfile
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer
from conftest import SMALL_PRESET, run_command
from hypothesis import given
from hypothesis import strategies as st
from idesplat.export import cli as export
from idesplat.export.released import cli as pull
from idesplat.runtime.cameras.io import write_cameras
from idesplat.runtime.cli import batch, convert, infer, models, refine, render, view, web
from idesplat.runtime.cli import cameras as convert_cameras
from idesplat.runtime.errors import printable
from idesplat.runtime.inference.metadata import StageFile, write_manifest
from idesplat.runtime.system.files import SCRATCH_PREFIX
from idesplat.runtime.web.third_party import VENDOR
from idesplat.tools.benchmark import cli as bench
from idesplat.tools.evaluation import cli as evaluate
from idesplat.tools.training import cli as train
from idesplat.tools.training import trainer
from mutations import TEXTS, make_odd_paths, mutated, mutated_json, tried
from scene_files import as_scene, pinholes, snapshot, write_scene
from tiny_model import write_model


@dataclass(frozen=True)
class Command:
    """A command: what its options are taken from, how it is called, and the files that a good call reads.

    function: has the options as its parameters. words: a good call. examples: how many calls are tried.
    """

    function: Callable
    main: Callable
    words: str
    reads: tuple[str, ...]
    examples: int


POSED = ("images/000.png", "images/001.png", "transforms.json")
MODEL = "--model model.onnx --near 1 --far 10"
IMAGES = "--images images --cameras transforms.json"
COMMANDS = {
    "infer": Command(
        infer.infer, infer.main, f"{IMAGES} {MODEL} --size 32x48 --out out/a.ply", (*POSED, "model.onnx"), 20
    ),
    "infer all": Command(
        infer.infer,
        infer.main,
        f"{IMAGES} {MODEL} --size 32x48 --views 2 --offset auto --out out/a.spz --save-depth out/depth "
        "--json out/a.json --report out/a.html --save-cameras out/c.json",
        (*POSED, "model.onnx"),
        6,
    ),
    "batch": Command(
        batch.batch,
        batch.main,
        "scenes.jsonl --out out --model model.onnx --near 1 --far 10 --size 32x48",
        (*POSED, "model.onnx", "scenes.jsonl"),
        4,  # each starts processes
    ),
    "render": Command(
        render.render,
        render.main,
        "scene.ply --cameras transforms.json --out out --size 16x24 --background 1,0,1",
        ("scene.ply", "transforms.json"),
        30,
    ),
    "orbit": Command(
        render.render,
        render.main,
        "scene.ply --orbit --frames 2 --out out --size 16x24 --depth --degrees 20",
        ("scene.ply",),
        15,
    ),
    "refine": Command(
        refine.refine,
        refine.main,
        f"scene.ply {IMAGES} --out out/a.ply --steps 2 --max-side 48",
        ("scene.ply", *POSED),
        10,
    ),
    "convert": Command(convert.convert, convert.main, "scene.ply out/a.splat --min-opacity 0.1", ("scene.ply",), 40),
    "cameras": Command(
        convert_cameras.convert,
        convert_cameras.main,
        "convert transforms.json out/c.json --images images",
        POSED,
        30,
    ),
    "cameras estimate": Command(
        convert_cameras.estimate,
        convert_cameras.main,
        "estimate images/000.png images/001.png --focal 50 --out out/c.json",
        ("images/000.png", "images/001.png"),
        10,
    ),
    "view": Command(view.view, view.main, f"scene.ply {IMAGES} --html out/a.html", ("scene.ply", *POSED), 15),
    "export": Command(
        export.export,
        export.main,
        "last.ckpt out/a.onnx --views 2 --size 64x96 --preset idesplat-tiny",
        ("last.ckpt",),
        20,
    ),
    "models": Command(models.models, models.main, "--json out/m.json", (), 10),
    "pull": Command(pull.pull, pull.main, "depthsplat-small-re10k --from last.ckpt", ("last.ckpt",), 10),
    "eval scene": Command(
        evaluate.scene,
        evaluate.main,
        f"scene images --cameras transforms.json --out out {MODEL} --size 32x48 --context 000 --context 001 "
        "--hold-out 002 --true-depth depth",
        (*POSED, "model.onnx", "depth/000.npz"),
        15,
    ),
    "eval chunks": Command(
        evaluate.chunks,
        evaluate.main,
        f"chunks chunks --index index.json --out out {MODEL}",
        ("chunks/0.torch", "index.json", "model.onnx"),
        15,
    ),
    "eval synthetic": Command(
        evaluate.synthetic,
        evaluate.main,
        "synthetic --model missing.onnx --out out --scenes 1 --size 32x48",
        (),
        15,
    ),
    "eval captures": Command(
        evaluate.captures,
        evaluate.main,
        "captures --checkouts checkouts --out out --views 2 --size 32x48 --model model.onnx",
        ("model.onnx",),
        10,
    ),
    "bench": Command(
        bench.bench,
        bench.main,
        "missing.onnx --views 2 --sizes 32x48 --repeats 1 --threads 1 --no-eager --json out/b.json --compare rows.json",
        ("rows.json",),
        2,  # each starts processes
    ),
    "train": Command(
        train.train,
        train.main,
        f"--out out --preset {SMALL_PRESET} --objective photometric --steps 1 --batch 1 --size 64 --data .",
        POSED,
        8,
    ),
}


if VENDOR.is_dir():  # else the files of the page come from the network
    COMMANDS["web"] = Command(web.web, web.main, "out/page --model model.onnx --size 32x48", ("model.onnx",), 4)


LPIPS_IS_MISSING = "warning: LPIPS is left out, since the package lpips is not installed\n"


@pytest.fixture(scope="module")
def good(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good input of every command, and a few paths that are none."""
    folder = tmp_path_factory.mktemp("good")
    for name in ("images", "depth", "chunks", "staged"):
        (folder / name).mkdir()
    names = [f"images/{number:03}.png" for number in range(3)]
    rng = np.random.default_rng(0)
    for name in names:
        cv2.imwrite(str(folder / name), rng.integers(0, 256, (32, 48, 3), np.uint8))
    cameras = [camera for camera in pinholes(names)]
    for camera in cameras:
        object.__setattr__(camera, "width", 48)
        object.__setattr__(camera, "height", 32)
    write_cameras(folder / "transforms.json", cameras)
    for number in range(3):
        np.savez(folder / "depth" / f"{number:03}.npz", depth=np.full((32, 48), 3.0, np.float32))
    write_scene(folder / "scene.ply")
    write_model(folder / "model.onnx")
    write_manifest(folder / "staged", [StageFile("a", "a.onnx", ["images"], ["depth"])])
    torch.save({"state_dict": {"encoder.a": torch.ones(3)}}, folder / "last.ckpt")
    torch.save([as_scene(scene, "a")], folder / "chunks" / "0.torch")
    (folder / "index.json").write_text(json.dumps({"a": {"context": [0, 4], "target": [1]}}))
    (folder / "rows.json").write_text(json.dumps({"version": 2, "machine": {}, "rows": []}))
    (folder / "scenes.jsonl").write_text(json.dumps({"id": "a", "images": "images", "cameras": "transforms.json"}))
    (folder / "notes.ply").write_text("the user's own")
    return folder


@pytest.fixture
def place(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presets: None) -> Iterator[Path]:
    """A copy of the good input, with odd paths beside it, in which we stand; temporary files go beside that folder."""
    work, temporary = tmp_path / "work", tmp_path / "temporary"
    shutil.copytree(good, work)
    temporary.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr("idesplat.tools.evaluation.captures.checkouts.fetch_checkout", no_network)
    monkeypatch.setattr(trainer.Trainer, "fit", lambda self, *arguments: None)  # training itself has tests of its own
    monkeypatch.setenv("IDESPLAT_RUN_LIMIT", "20")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")  # nobody listens there
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / f"{tmp_path.name}-cache"))
    threads = torch.get_num_threads()
    yield work
    torch.set_num_threads(threads)
    torch.set_flush_denormal(False)


def no_network(*arguments: object, **options: object) -> typing.NoReturn:
    from idesplat.runtime.errors import InputError

    raise InputError("no network in tests; give --checkouts")


def options_of(function: Callable) -> list[tuple[str, bool]]:
    """The options of a command, and whether each takes a value."""
    hints = typing.get_type_hints(inspect.unwrap(function), include_extras=True)
    found = []
    for name, hint in hints.items():
        kind, *extras = typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint,)
        if any(isinstance(extra, typer.models.OptionInfo) for extra in extras):
            declared = next(extra for extra in extras if isinstance(extra, typer.models.OptionInfo)).param_decls or ()
            flag = next(iter(declared), f"--{name.replace('_', '-')}")
            found.append((flag.split("/")[0], kind is not bool))
    return found


@st.composite
def calls(draw: st.DrawFn, command: Command, odd: list[str], good: Path) -> tuple[list[str], dict[str, bytes]]:
    """The words of a call with one to three things wrong, and the files whose content is another meanwhile."""
    words, files = command.words.split(), {}
    options = options_of(command.function)
    assert options, command
    values = st.sampled_from(TEXTS) | st.sampled_from(odd) | st.text(max_size=6)
    for kind in draw(st.lists(st.sampled_from(("value", "option", "file", "path", "drop")), min_size=1, max_size=3)):
        if kind == "file" and command.reads:
            name = draw(st.sampled_from(command.reads))
            content = (good / name).read_bytes()
            json_too = mutated_json(json.loads(content)) if name.endswith("json") else st.nothing()
            files[name] = draw(mutated(content) | json_too)
        elif kind == "option":
            flag, takes_value = draw(st.sampled_from(options))
            words += [flag, draw(values)] if takes_value else [flag]
        elif kind == "drop":
            del words[draw(st.integers(0, len(words) - 1))]
        elif words:
            at = draw(st.integers(0, len(words) - 1))
            words[at] = draw(values if kind == "value" else st.sampled_from(odd))
        words = words or [""]
    return words, files


def assert_shown(text: str) -> None:
    """No control characters, overrides of direction or lone surrogates reach the terminal, and no traceback."""
    assert printable(text.replace("\n", "")) == text.replace("\n", ""), text[:500]
    assert "Traceback" not in text


@pytest.mark.slow
@pytest.mark.posix
@pytest.mark.parametrize("name", COMMANDS)
def test_any_call_succeeds_or_changes_nothing(
    name: str, good: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, odd = COMMANDS[name], make_odd_paths(place)
    (place / "checkouts").mkdir()
    root = place.parent

    @tried(command.examples)
    @given(call=calls(command, odd, good))
    def check(call: tuple[list[str], dict[str, bytes]]) -> None:
        words, files = call
        for changed, content in files.items():
            (place / changed).write_bytes(content)
        before = snapshot(root)
        capsys.readouterr()
        try:
            if not serves(command, words):
                status = run_command(command.main, *words)
                check_result(status, *capsys.readouterr(), before, root)
        finally:
            restore(before, root)
            for changed in files:
                shutil.copy(good / changed, place / changed)

    check()


def serves(command: Command, words: list[str]) -> bool:
    """Whether the call would serve a page until it is interrupted."""
    shows = command.function is view.view and "--html" not in words
    return "--help" not in words and (shows or (command.function is web.web and "--serve" in words))


def check_result(status: int, out: str, err: str, before: dict, root: Path) -> None:
    after = snapshot(root)
    err = err.replace(LPIPS_IS_MISSING, "")
    assert_shown(out)
    assert_shown(err)
    assert status in (0, 2, batch.SOME_FAILED)
    if status == 2 and err.startswith("error: "):
        assert err.count("\n") == 1, err[:1000]
        assert after == before, sorted(set(after) ^ set(before))
    elif status == 2:
        assert "Usage:" in out + err  # no arguments at all: the help
    assert not [path for path in after if path.name.startswith(SCRATCH_PREFIX)]
    assert not list((root / "temporary").iterdir())
    assert {path: after.get(path) for path in before} == before


def restore(before: dict, root: Path) -> None:
    """Remove what a call has written."""
    for path in sorted(set(snapshot(root)) - set(before), reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()


@pytest.mark.parametrize("name", [name for name in COMMANDS if "missing.onnx" not in COMMANDS[name].words])
def test_the_good_calls_get_far(name: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Or else nothing is tried but how the first mistake is refused."""
    (place / "checkouts").mkdir()
    status = run_command(COMMANDS[name].main, *COMMANDS[name].words.split())
    err = capsys.readouterr().err.replace(LPIPS_IS_MISSING, "")
    late = {
        "export": "does not fit the network",
        "cameras estimate": "features match",
        "pull": "expected cfeab6b1",
        "eval captures": "no network",
        "train": "expected at least",
    }
    assert (status, err) == (0, "") if name not in late else late[name] in err, err
