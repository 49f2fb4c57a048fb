"""What a worker does with a scene, in this process."""

import json
import shutil
from dataclasses import replace

import pytest
from idesplat.runtime.batch.inputs import LocalInputs
from idesplat.runtime.batch.records import fingerprint, model_sha256, read_record, write_record
from idesplat.runtime.batch.results import LocalResults
from idesplat.runtime.batch.run import batch
from idesplat.runtime.batch.scenes import Scene
from idesplat.runtime.batch.worker import Settings, Worker, record_killed
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.metadata import StageFile, write_manifest
from idesplat.runtime.inference.model_files import read_model
from idesplat.runtime.inference.session import DEFAULT
from tiny_model import NETWORK, write_model

WRONG = (
    ({"nears": 1}, "unknown option 'nears'"),
    ({"near": 0.0}, "near 0: expected a positive depth"),
    ({"far": float("nan")}, "far nan: expected a positive depth"),
    ({"near": 3.0, "far": 2.0}, "near 3 and far 2: expected near < far"),
    ({"refine": "soon"}, "--refine soon"),
    ({"offset": "1,2"}, "--offset 1,2"),
    ({"max_gaussians": -1}, "max_gaussians -1"),
    ({"min_opacity": 2.0}, "--min-opacity 2"),
)


@pytest.fixture
def worker(tmp_path):
    model = read_model(write_model(tmp_path / "tiny.onnx"))
    return Worker(Settings(model, model_sha256(model), "CPU", DEFAULT, {}, tmp_path / "out"))


@pytest.fixture
def own(scene, tmp_path):
    """A scene whose files may be changed."""
    return Scene("a", shutil.copytree(scene, tmp_path / "own"))


def test_a_scene_is_done_once(worker, own, tmp_path):
    record, tried = worker.run(own)
    assert tried
    assert record["status"] == "done"
    assert record == read_record(LocalResults(tmp_path / "out" / "a"))
    assert worker.run(own) == (record, False)
    changed = Scene("a", own.images, options={"views": 3})
    again, tried = worker.run(changed)
    assert tried
    assert (len(record["views"]), len(again["views"])) == (2, 3)


def test_a_failure_that_cannot_be_written_is_returned(worker, own, tmp_path):
    (tmp_path / "out").write_text("a file where a folder is needed, as a disk that is full")
    record, tried = worker.run(own)
    assert tried
    assert record["status"] == "failed"
    assert "cannot create the folder" in record["error"]


@pytest.mark.parametrize("began", [True, False])
def test_what_a_killed_worker_wrote_is_removed_and_results_before_it_stay(worker, own, tmp_path, began):
    """The kill may come when the splats are there and the record is not yet."""
    record = worker.run(own).record
    results = LocalResults(tmp_path / "out" / "a")
    if began:
        write_record(results, {"id": "a", "hash": record["hash"], "status": "writing"})
    assert record_killed(own, worker.settings).record["status"] == "failed"
    assert read_record(results)["hash"] == record["hash"]
    assert [results.exists(name) for name in ("scene.ply", "picture.jpg")] == [not began] * 2


def test_a_scene_that_fails_keeps_its_older_results_until_there_are_new_ones(worker, own, tmp_path):
    """Only the reconstruction finds that no image has the number that is selected."""
    done = worker.run(own).record
    results, failing = LocalResults(tmp_path / "out" / "a"), Scene("a", own.images, options={"select": "99"})
    before = results.read("scene.ply")
    failed, _ = worker.run(failing)
    assert failed["status"] == "failed"
    assert failed == read_record(results)
    assert (failed["files"], results.read("scene.ply")) == (done["files"], before)
    assert worker.run(failing) == (failed, False)
    # Splats of another format replace those that the failure has left.
    assert Worker(replace(worker.settings, splat_format="spz")).run(own).record["status"] == "done"
    assert sorted(path.name for path in results.folder.iterdir()) == ["picture.jpg", "record.json", "scene.spz"]


def test_what_a_killed_worker_wrote_is_removed_before_the_next_attempt(worker, own, tmp_path):
    worker.run(own)
    results = LocalResults(tmp_path / "out" / "a")
    write_record(results, {"id": "a", "hash": "of others", "status": "writing"})
    assert worker.run(replace(own, images=tmp_path / "missing")).record["status"] == "failed"
    assert not any(results.exists(name) for name in ("scene.ply", "picture.jpg"))


def test_a_worker_that_is_killed_before_it_writes_leaves_older_results(worker, own, tmp_path):
    record = worker.run(own).record
    results = LocalResults(tmp_path / "out" / "a")
    write_record(results, {"id": "a", "hash": "of others", "status": "started", "files": record["files"]})
    killed = record_killed(own, worker.settings).record
    assert (killed["hash"], killed["files"]) == ("of others", record["files"])
    assert all(results.exists(name) for name in ("scene.ply", "picture.jpg"))


def test_splats_do_not_stand_beside_the_record_of_a_failure(worker, own, tmp_path):
    """The splats are there when the picture cannot be written: a folder stands in its place."""
    (tmp_path / "out" / "a" / "picture.jpg").mkdir(parents=True)
    record, _ = Worker(replace(worker.settings, overwrite=True)).run(own)
    assert record["status"] == "failed"
    assert "picture.jpg" in record["error"]
    assert not (tmp_path / "out" / "a" / "scene.ply").exists()


def test_older_splats_stay_where_the_start_cannot_be_written(worker, own, tmp_path):
    """A folder stands in the record's place, as on a disk that is full."""
    folder = tmp_path / "out" / "a"
    (folder / "record.json" / "x").mkdir(parents=True)
    (folder / "scene.ply").write_text("older")
    record, _ = Worker(replace(worker.settings, overwrite=True)).run(own)
    assert record["status"] == "failed"
    assert (folder / "scene.ply").read_text() == "older"


def test_a_failure_stands_until_the_inputs_change(worker, own, tmp_path):
    cameras = own.images / "transforms.json"
    good = cameras.read_text()
    cameras.write_text(json.dumps({**json.loads(good), "frames": []}))
    failing = Scene("a", own.images / "images", cameras)
    record, tried = worker.run(failing)
    assert tried
    assert record["status"] == "failed"
    assert "Traceback" in (tmp_path / "out" / "a" / "error.txt").read_text()
    assert worker.run(failing) == (record, False)
    cameras.write_text(good)
    assert worker.run(failing).record["status"] == "done"
    assert not (tmp_path / "out" / "a" / "error.txt").exists()


def test_the_hash_changes_with_what_the_splats_are_made_from(own):
    def made_from(options=None, model="m", provider="CPU", splats="ply", images=own.images, cameras=None):
        scene = Scene("a", images, cameras)
        return fingerprint(scene, LocalInputs(scene).hashes(), options or {}, model, provider, splats)

    before = made_from()
    (own.images / "notes.txt").write_text("not read")
    assert made_from() == before
    others = [
        made_from({"near": 1.0}),
        made_from(model="n"),
        made_from(provider="CUDA"),
        made_from(splats="spz"),
        made_from(images=own.images / "images", cameras="estimate"),
    ]
    with (own.images / "transforms.json").open("a") as file:
        file.write(" ")
    others.append(made_from())
    (own.images / "images" / "004.png").unlink()
    others.append(made_from())
    assert len({before, *others}) == len(others) + 1


def test_a_staged_models_hash_covers_each_file(tmp_path):
    stages = [StageFile("first", "first.onnx", ["images"], ["depth"]), StageFile("last", "last.onnx", ["depth"], [])]
    (tmp_path / "staged").mkdir()
    for stage in stages:
        write_model(tmp_path / "staged" / stage.file)
    write_manifest(tmp_path / "staged", stages)
    before = model_sha256(read_model(tmp_path / "staged"))
    assert model_sha256(read_model(tmp_path / "staged")) == before
    write_model(tmp_path / "staged" / "last.onnx", checkpoint="another.ckpt")
    assert model_sha256(read_model(tmp_path / "staged")) != before


def test_nothing_of_others_is_replaced_and_nothing_stands_among_inputs(own, tmp_path):
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    shutil.copytree(own.images, scenes / "a")
    (out / "a").mkdir(parents=True)
    (out / "a" / "scene.ply").write_text("the user's own")
    for target, said in ((out, "did not write it"), (scenes / "out", "is an input"), (scenes, "is an input")):
        with pytest.raises(InputError, match=said):
            batch(scenes, target, model=tmp_path / "tiny.onnx")
    for options, said in WRONG:
        with pytest.raises(InputError, match=said):
            batch(scenes, tmp_path / "new", options=options)
    with pytest.raises(InputError, match="--engine dask: expected local or ray"):
        batch(scenes, tmp_path / "new", engine="dask")
    assert not (tmp_path / "new").exists()
    assert (out / "a" / "scene.ply").read_text() == "the user's own"


@pytest.mark.slow
def test_a_model_that_cannot_be_opened_ends_the_run_and_leaves_nothing(own, tmp_path):
    shutil.copytree(own.images, tmp_path / "scenes" / "a")
    model = write_model(tmp_path / "wrong.onnx", NETWORK.replace("Abs (means)", "Absent (means)"))
    with pytest.raises(InputError, match="ONNX Runtime cannot load it"):
        batch(tmp_path / "scenes", tmp_path / "out", model=model)
    assert not (tmp_path / "out").exists()
