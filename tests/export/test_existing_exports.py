"""What an export replaces, and what it does not; and that a run killed at any step leaves the old result or the new."""

import json
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from idesplat.export import existing_exports as written
from idesplat.export.existing_exports import (
    check_replaceable,
    foreign_entries,
    is_our_graph,
    replace_folder,
    working_folder,
)
from idesplat.export.graph import external_data as weights
from idesplat.export.graph.external_data import publish, save_model
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.metadata import MANIFEST_NAME, METADATA_KEY, StageFile, write_manifest
from onnx import TensorProto, helper, numpy_helper

CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.chmod", "shutil.rmtree", "tempfile.mkdtemp")
MOST_STEPS = 200


def graph(value, ours=True):
    """A graph that adds `value` to its input."""
    node = helper.make_node("Add", ["x", "weight"], ["y"])
    shape = (TensorProto.FLOAT, [1024])
    inputs, outputs = ([helper.make_tensor_value_info(name, *shape)] for name in "xy")
    weight = numpy_helper.from_array(np.full(1024, value, np.float32), "weight")
    model = helper.make_model(helper.make_graph([node], "net", inputs, outputs, [weight]))
    if ours:
        helper.set_model_props(model, {METADATA_KEY: "{}"})
    return model


def write_staged(folder, value):
    folder.mkdir()
    onnx.save(graph(value), folder / "encoder.onnx")
    write_manifest(folder, [StageFile("encoder", "encoder.onnx", ["x"], ["y"])])
    return folder


def value_of(path):
    """What a graph adds; raises where its weights are not those that it was written with."""
    (weight,) = onnx.load(path).graph.initializer
    values = numpy_helper.to_array(weight)
    assert values.shape == (1024,) and len(np.unique(values)) == 1
    return values[0]


def tree(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# ---- what is ours


def test_our_graph_is_known_by_its_metadata(exported, tmp_path):
    assert is_our_graph(exported[0])
    onnx.save(graph(1, ours=False), tmp_path / "other.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    (tmp_path / "empty.onnx").touch()
    (tmp_path / "folder.onnx").mkdir()
    (tmp_path / "link.onnx").symlink_to(exported[0])
    for name in ("other", "text", "empty", "folder", "link", "absent"):
        assert not is_our_graph(tmp_path / f"{name}.onnx")


def test_a_staged_export_holds_nothing_foreign(exported):
    assert foreign_entries(exported[1]) == []


def add_file(folder):
    (folder / "thesis.txt").write_text("text")


def add_folder(folder):
    (folder / "images").mkdir()


def add_hidden(folder):
    (folder / ".git").mkdir()


def name_a_foreign_file(folder):
    add_file(folder)
    write_manifest(folder, [StageFile(name, name, [], []) for name in ("encoder.onnx", "thesis.txt")])


def name_a_foreign_graph(folder):
    onnx.save(graph(1, ours=False), folder / "other.onnx")
    write_manifest(folder, [StageFile(name, name, [], []) for name in ("encoder.onnx", "other.onnx")])


def name_a_file_elsewhere(folder):
    add_file(folder)
    write_manifest(folder, [StageFile("a", "../staged/thesis.txt", [], []), StageFile("b", "encoder.onnx", [], [])])


def link_a_stage(folder):
    (folder / "encoder.onnx").rename(folder.parent / "elsewhere.onnx")
    (folder / "encoder.onnx").symlink_to(folder.parent / "elsewhere.onnx")


def manifest_of_another_program(folder):
    (folder / MANIFEST_NAME).write_text(json.dumps({"name": "app", "stages": [{"file": "encoder.onnx"}]}))


def manifest_is_a_list(folder):
    (folder / MANIFEST_NAME).write_text("[1, 2]")


def manifest_is_damaged(folder):
    (folder / MANIFEST_NAME).write_bytes(b"\xff{")


def manifest_nests_deeply(folder):
    (folder / MANIFEST_NAME).write_text("[" * 100_000)


def no_manifest(folder):
    (folder / MANIFEST_NAME).unlink()


FOREIGN = [
    add_file,
    add_folder,
    add_hidden,
    name_a_foreign_file,
    name_a_foreign_graph,
    name_a_file_elsewhere,
    link_a_stage,
    manifest_of_another_program,
    manifest_is_a_list,
    manifest_is_damaged,
    manifest_nests_deeply,
    no_manifest,
]


@pytest.mark.parametrize("change", FOREIGN)
@pytest.mark.parametrize("exchange", (True, False))
def test_a_folder_that_holds_anything_else_is_never_replaced(change, exchange, tmp_path, monkeypatch):
    if not exchange:
        monkeypatch.setattr(written, "_exchange", lambda *_: False)
    folder = write_staged(tmp_path / "staged", 1)
    change(folder)
    before = tree(tmp_path)
    with pytest.raises(InputError, match="did not write") as error:
        check_replaceable(folder)
    assert "\n" not in str(error.value)
    with working_folder(tmp_path) as working, pytest.raises(InputError, match="did not write"):
        replace_folder(write_staged(working / "new", 2), folder)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("exchange", (True, False))
def test_a_file_that_arrives_at_the_last_moment_is_kept(exchange, tmp_path, monkeypatch):
    """It comes between the check and the replacement; the folder is put back."""
    folder = write_staged(tmp_path / "staged", 1)
    real = written._exchange

    def late(new, old):
        if not (tmp_path / "came").exists():
            (tmp_path / "came").touch()
            add_file(old)
        return exchange and real(new, old)

    monkeypatch.setattr(written, "_exchange", late)
    with working_folder(tmp_path) as working, pytest.raises(InputError, match=r"thesis\.txt"):
        replace_folder(write_staged(working / "new", 2), folder)
    assert value_of(folder / "encoder.onnx") == 1
    assert (folder / "thesis.txt").read_text() == "text"


@pytest.mark.parametrize("make", (lambda path: None, Path.mkdir, lambda path: write_staged(path, 1)))
@pytest.mark.parametrize("exchange", (True, False))
def test_no_folder_an_empty_one_and_ours_are_replaced(make, exchange, tmp_path, monkeypatch):
    if not exchange:
        monkeypatch.setattr(written, "_exchange", lambda *_: False)
    make(tmp_path / "staged")
    with working_folder(tmp_path) as working:
        replace_folder(write_staged(working / "new", 2), tmp_path / "staged")
    assert value_of(tmp_path / "staged" / "encoder.onnx") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["staged"]


# ---- killed at every step


def killed_at(step, action):
    """Run an action in a process that is killed before its change of that number to the file system; whether it was."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        left = step

        def watch(event, arguments):
            nonlocal left
            writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            if event in CHANGES or writes:
                left -= 1
                if left < 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        try:
            sys.addaudithook(watch)
            action()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def each_kill(action, restore):
    """Each state in which a killed run leaves what `restore` set up, and at last that of a run that is not killed."""
    for step in range(MOST_STEPS):
        restore()
        killed = killed_at(step, action)
        yield step
        if not killed:
            return
    pytest.fail("the action never ended")


@pytest.mark.posix
@pytest.mark.parametrize("exchange", (True, False))
def test_a_staged_folder_is_the_old_or_the_new_one_wherever_a_run_is_killed(exchange, tmp_path, monkeypatch):
    """Where folders cannot be exchanged, once the next run has begun."""
    if not exchange:
        monkeypatch.setattr(written, "_exchange", lambda *_: False)
    place = tmp_path / "place"
    folder = place / "staged"

    def export():
        with working_folder(place) as working:
            replace_folder(write_staged(working / "new", 2), folder)

    def restore():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        write_staged(folder, 1)

    found = []
    for _ in each_kill(export, restore):
        if not exchange:
            with working_folder(place):
                pass
        found.append(value_of(folder / "encoder.onnx"))
        assert foreign_entries(folder) == []
        with working_folder(place):
            assert len(list(place.iterdir())) <= 3  # the folder, this run's, and at most one that never had its lock
        assert value_of(folder / "encoder.onnx") == found[-1]
    assert found == sorted(found) and set(found) == {1, 2}
    assert len(found) > 5


@pytest.mark.posix
def test_a_graph_and_its_weights_belong_together_wherever_a_run_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "LARGEST_FILE", 1000)
    place, source = tmp_path / "place", tmp_path / "source"
    source.mkdir()
    for value in (1, 2):
        save_external(graph(value), source / f"{value}.onnx")

    def export(value):
        with working_folder(place) as working:
            (working / "fused").mkdir()
            return publish(save_model(source / f"{value}.onnx", working / "fused" / "model.onnx"), place)

    def restore():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        export(1)

    found = []
    for _ in each_kill(lambda: export(2), restore):
        found.append(value_of(place / "model.onnx"))
        assert len(export(2)) == 2
        assert value_of(place / "model.onnx") == 2
        left = [path.name for path in place.iterdir() if not path.name.startswith(written.WORKING_PREFIX)]
        assert len(left) == 2  # the graph and its weights, none of the killed run's
    assert found == sorted(found) and set(found) == {1, 2}
    assert len(found) > 5


def save_external(model, path):
    onnx.save(model, path, save_as_external_data=True, location=f"{path.name}.weights", size_threshold=0)


def test_weights_of_a_graph_that_was_replaced_go_unless_another_graph_reads_them(tmp_path, monkeypatch):
    source, place = tmp_path / "source", tmp_path / "place"
    source.mkdir()
    place.mkdir()
    save_external(graph(1), source / "graph.onnx")
    monkeypatch.setattr(weights, "LARGEST_FILE", 1000)
    _, beside = publish(save_model(source / "graph.onnx", source / "model.onnx"), place)
    shutil.copy(place / "model.onnx", place / "copy.onnx")
    (place / "model.onnx.0123456789abcdef.data").write_text("not what the name says")
    monkeypatch.undo()
    publish(save_model(source / "graph.onnx", source / "model.onnx"), place)
    assert value_of(place / "copy.onnx") == value_of(place / "model.onnx") == 1
    (place / "copy.onnx").unlink()
    publish(save_model(source / "graph.onnx", source / "model.onnx"), place)
    assert not beside.exists()
    assert {path.name for path in place.iterdir()} == {"model.onnx", "model.onnx.0123456789abcdef.data"}


def test_a_working_folder_in_use_is_left_alone(tmp_path):
    with working_folder(tmp_path) as first:
        (first / "graph").touch()
        with working_folder(tmp_path):
            assert (first / "graph").exists()
    assert list(tmp_path.iterdir()) == []
