"""Released models by name, from a server with the hub's interface and files of the released layout, and from a folder.

The networks are tiny; keys, containers and names are those of the releases. The real files were out of reach.
"""

import hashlib
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from conftest import run_command
from depthsplat_cases import ONE_SCALE
from hub_server import COMMIT, Hub, serve_hub
from idesplat import Predictor
from idesplat.export import pipeline
from idesplat.export.released import cli, download
from idesplat.export.released.download import fetch_checkpoint
from idesplat.model.depthsplat.keys import rename_released
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.cli import models
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.known_models import DEPTHSPLAT, KNOWN_MODELS, KnownModel
from idesplat.runtime.inference.named_models import find_model
from idesplat.runtime.system.progress import Progress, reporting_to
from reference_weights import FOLDER

NAME = "depthsplat-nano"


def released_file() -> bytes:
    """A checkpoint of the tiny network as the authors save theirs: their keys, with the wrapper's prefix."""
    torch.manual_seed(0)
    own = build(ONE_SCALE).state_dict()
    keys = json.loads((FOLDER / "depthsplat-small-2v-256x256" / "state_dict_keys.json").read_text())
    theirs = {ours: key for ours, key in rename_released({key: key for key in keys}).items() if ours in own}
    assert set(theirs) == set(own)
    file = io.BytesIO()
    torch.save({f"encoder.{key}": own[ours] for ours, key in theirs.items()}, file)
    return file.getvalue()


@pytest.fixture(scope="module")
def content() -> bytes:
    return released_file()


@pytest.fixture
def nano(content, monkeypatch, tmp_path) -> KnownModel:
    """A released model that is tiny, known by name, and a cache of its own."""
    digest = hashlib.sha256(content).hexdigest()[:8]
    file = f"depthsplat-gs-nano-re10k-256x256-view2-{digest}.pth"
    model = KnownModel(NAME, "DepthSplat", 0.1, ONE_SCALE.height, ONE_SCALE.width, (2, 2), DEPTHSPLAT, file)
    monkeypatch.setitem(KNOWN_MODELS, NAME, model)
    monkeypatch.setitem(PRESETS, NAME, ONE_SCALE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    return model


@pytest.fixture
def hub(nano, content, monkeypatch):
    with serve_hub({f"{DEPTHSPLAT}/resolve/main/{nano.file}": content}) as served:
        monkeypatch.setenv("HF_ENDPOINT", served.url)
        yield served


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else []


@pytest.mark.slow
def test_a_model_is_pulled_by_name_and_runs(hub: Hub, nano, kept_traces, tmp_path, capsys):
    assert run_command(cli.main, NAME) == 0
    printed = capsys.readouterr().out
    graph = tmp_path / "cache" / "idesplat" / "models" / f"{NAME}.onnx"
    assert f"wrote {graph}\n" in printed
    assert f"licence: MIT, as its authors state; https://huggingface.co/{DEPTHSPLAT}\n" in printed
    assert f"use it with: idesplat infer PHOTOS --model {NAME}\n" in printed
    assert find_model(NAME) == graph
    own = Predictor(NAME).metadata
    assert (own.preset, own.checkpoint, own.checkpoint_sha256[:8]) == (NAME, nano.file, nano.sha256_prefix)

    before = len(hub.requests)
    assert run_command(cli.main, NAME) == 0
    assert f"is in the cache already: {graph}\n" in capsys.readouterr().out
    assert len(hub.requests) == before
    assert run_command(cli.main, NAME, "--revision", "no-such-branch") == 2
    assert f"cannot be downloaded from {hub.url}/{DEPTHSPLAT} at no-such-branch" in capsys.readouterr().err
    assert run_command(cli.main, NAME, "--from", tmp_path) == 2
    assert f"no such file; give the folder that has {nano.file}" in capsys.readouterr().err

    assert run_command(models.main, "--json", "-") == 0
    listed = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert (listed[NAME]["state"], listed[NAME]["path"]) == ("cached", str(graph))
    assert (listed["idesplat-lite"]["state"], listed["idesplat-re10k"]["state"]) == ("bundled", "known")


def test_a_download_is_kept_in_our_cache_and_not_repeated(hub: Hub, nano, content, tmp_path):
    first = fetch_checkpoint(nano)
    assert first.read_bytes() == content
    assert COMMIT in first.parts
    assert first.is_relative_to(tmp_path / "cache" / "idesplat")
    assert fetch_checkpoint(nano) == first
    assert [method for method, *_ in hub.requests] == ["HEAD", "GET"]


def test_without_any_server_a_download_is_found_again(nano, content, monkeypatch):
    with serve_hub({f"{DEPTHSPLAT}/resolve/main/{nano.file}": content}) as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        first = fetch_checkpoint(nano)
    assert fetch_checkpoint(nano) == first


def test_an_interrupted_download_goes_on_where_it_ended(hub: Hub, nano):
    """The hub's library writes pieces of 10 MB, so the file has several."""
    large = bytes(35_000_000)
    model = replace(nano, file=f"depthsplat-gs-large-{hashlib.sha256(large).hexdigest()[:8]}.pth")
    hub.files[f"{DEPTHSPLAT}/resolve/main/{model.file}"] = large
    hub.cut = 25_000_000
    with pytest.raises(InputError, match=r"cannot be downloaded from .* \(.*\); pull it again to resume"):
        fetch_checkpoint(model)
    hub.closed = False
    path = fetch_checkpoint(model)
    assert path.stat().st_size == len(large)
    last = [asked for method, _, asked in hub.requests if method == "GET"][-1]
    assert int(last.removeprefix("bytes=").partition("-")[0]) >= 20_000_000
    assert [file.name for file in path.parent.iterdir()] == [model.file]


def test_progress_is_reported(hub: Hub, nano, content):
    reports: list[Progress] = []
    with reporting_to(reports.append):
        fetch_checkpoint(nano)
    mine = [report for report in reports if report.description == f"downloading {nano.file}"]
    assert (mine[-2].done, mine[-1].total, mine[-1].ended) == (len(content), len(content), True)


def test_a_commit_can_be_pinned(hub: Hub, nano, content):
    hub.files[f"{DEPTHSPLAT}/resolve/{COMMIT}/{nano.file}"] = content
    fetch_checkpoint(nano, revision=COMMIT)
    assert {path.split("/")[4] for _, path, _ in hub.requests} == {COMMIT}


def test_a_file_with_another_hash_is_refused_and_removed(hub: Hub, nano, content, tmp_path, capsys):
    (path,) = hub.files
    hub.files[path] = content[:5000] + bytes([content[5000] ^ 1]) + content[5001:]
    assert run_command(cli.main, NAME) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert f"expected {nano.sha256_prefix}: it is damaged, or not the released file; it was removed" in printed
    assert not any(name.endswith((".pth", ".onnx")) for name in files_in(tmp_path / "cache"))
    hub.files[path] = content
    assert fetch_checkpoint(nano).read_bytes() == content  # the damaged one is not found again


def test_a_file_that_is_not_on_the_hub_is_one_line(hub: Hub, nano, capsys):
    hub.files.clear()
    assert run_command(cli.main, NAME) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {nano.file} cannot be downloaded from {hub.url}/{DEPTHSPLAT} at main (")
    assert printed.endswith("or give a folder that has it as --from\n")
    assert printed.count("\n") == 1


@pytest.mark.parametrize("commit", ("", "../../../up"))
def test_a_server_that_states_no_commit_is_refused(commit, hub: Hub, nano, tmp_path):
    hub.commit = commit
    with pytest.raises(InputError, match=r"cannot be downloaded from .* \(.*hub"):
        fetch_checkpoint(nano)
    assert not files_in(tmp_path)


def test_a_folder_takes_the_place_of_a_download(nano, content, tmp_path):
    (tmp_path / "files").mkdir()
    path = tmp_path / "files" / nano.file
    path.write_bytes(content)
    assert fetch_checkpoint(nano, tmp_path / "files") == fetch_checkpoint(nano, path) == path
    shutil.copy(path, tmp_path / "damaged.pth")
    with (tmp_path / "damaged.pth").open("r+b") as file:
        file.write(b"\0")
    with pytest.raises(InputError, match=rf"damaged\.pth: its SHA-256 begins with .*expected {nano.sha256_prefix}"):
        fetch_checkpoint(nano, tmp_path / "damaged.pth")
    assert (tmp_path / "damaged.pth").exists()  # the user's own file
    with pytest.raises(InputError, match=rf"no such file; give the folder that has {nano.file}"):
        fetch_checkpoint(nano, tmp_path)


def test_a_file_whose_name_has_no_hash_is_compared_with_the_hubs(hub: Hub, nano, content, tmp_path):
    plain = KnownModel(NAME, "IDESplat", 0.1, 64, 64, (2, 2), DEPTHSPLAT, "idesplat-nano.ckpt")
    hub.files[f"{DEPTHSPLAT}/resolve/main/{plain.file}"] = content
    hub.etag = "0" * 64
    with pytest.raises(InputError, match=r"expected 00000000: .* it was removed; pull it again"):
        fetch_checkpoint(plain)
    assert not files_in(tmp_path / "cache")
    hub.etag = ""
    assert fetch_checkpoint(plain).read_bytes() == content


def test_pytorch_is_asked_for_before_anything_is_downloaded(hub: Hub, nano, monkeypatch, capsys):
    monkeypatch.setattr(pipeline, "find_spec", lambda name: None)
    assert run_command(cli.main, NAME) == 2
    printed = capsys.readouterr().err
    assert printed == (
        "error: exporting needs PyTorch and onnx, which are not installed; pip install 'idesplat[export]'\n"
    )
    assert not hub.requests


def test_the_hubs_library_is_asked_for(nano, monkeypatch, capsys):
    monkeypatch.setattr(download, "find_spec", lambda name: None)
    assert run_command(cli.main, NAME) == 2
    assert "huggingface_hub, which is not installed; pip install 'idesplat[hub]'" in capsys.readouterr().err


def test_an_unknown_name_lists_the_known_ones(capsys):
    assert run_command(cli.main, "depthsplat") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: depthsplat: no model of this name is known; choose one of idesplat-re10k, ")
    assert printed.count("\n") == 1


def test_the_bundled_model_needs_no_download(capsys):
    assert run_command(cli.main, "idesplat-lite") == 0
    assert capsys.readouterr().out.startswith("idesplat-lite is bundled: ")
