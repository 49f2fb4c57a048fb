"""Models by name: what is known agrees with the presets, and a name or a path leads to a file."""

import re
from pathlib import Path

import pytest
import torch
from conftest import run_command
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.cli import infer
from idesplat.runtime.cli.models import BUNDLED_MILLIONS
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.inference.known_models import KNOWN_MODELS
from idesplat.runtime.inference.model_files import read_model
from idesplat.runtime.inference.named_models import cached_path, find_model


@pytest.mark.parametrize("name", KNOWN_MODELS)
def test_the_table_agrees_with_the_preset(name):
    model, config = KNOWN_MODELS[name], PRESETS[name]
    assert (model.height, model.width, model.views) == (config.height, config.width, tuple(config.trained_views))
    assert millions(name) == pytest.approx(model.parameters, abs=0.05)
    assert model.gaussians == getattr(config, "gaussians", True)


def millions(preset: str) -> float:
    """The number of a network's parameters, in millions."""
    with torch.device("meta"):
        network = build(preset)
    return sum(parameter.numel() for parameter in network.parameters()) / 1e6


def test_the_size_of_the_bundled_model_is_its_presets():
    assert millions(read_model(bundled_model()).metadata.preset) == pytest.approx(BUNDLED_MILLIONS, abs=0.05)


@pytest.mark.parametrize("name", KNOWN_MODELS)
def test_the_files_name_says_the_same(name):
    model = KNOWN_MODELS[name]
    assert f"-{model.height}x{model.width}-" in model.file
    (views,) = re.findall(r"view([\d-]+\d|\d)[-.]", model.file)
    assert tuple(map(int, views.split("-"))) in (model.views, model.views[:1])
    assert bool(model.sha256_prefix) == model.file.endswith(".pth")


def test_no_model_is_the_bundled_one():
    assert find_model() == find_model("idesplat-lite") == bundled_model()
    assert read_model("idesplat-lite").path == bundled_model()


def test_paths_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in ("missing.onnx", "folder/idesplat-re10k", "./idesplat-re10k"):
        assert find_model(path) == Path(path)
    (tmp_path / "idesplat-re10k").mkdir()  # such as a staged folder
    assert find_model("idesplat-re10k") == Path("idesplat-re10k")


def test_a_known_model_that_is_not_there_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(InputError, match=r"^idesplat-re10k: is not in the cache yet; `idesplat pull idesplat-re10k`"):
        find_model("idesplat-re10k")
    cached_path("idesplat-re10k").parent.mkdir(parents=True)
    cached_path("idesplat-re10k").touch()
    assert find_model("idesplat-re10k") == tmp_path / "idesplat" / "models" / "idesplat-re10k.onnx"


def test_an_unknown_name_lists_what_there_is(scene, tmp_path, capsys):
    out = tmp_path / "scene.ply"
    assert run_command(infer.main, scene / "images", "--model", "idesplat-huge", "--out", out) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: idesplat-huge: no such model; give a .onnx file or staged folder")
    assert all(name in printed for name in ("idesplat-lite", *KNOWN_MODELS))
    assert printed.count("\n") == 1
    assert not out.exists()
