"""Batches from and to a store: a server of S3 on the loopback address, which cannot rename, and fsspec's memory."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import idesplat
import pytest
from idesplat.runtime.batch.cache import InputCache
from idesplat.runtime.batch.inputs import StoredInputs
from idesplat.runtime.batch.places import beside, parse_place
from idesplat.runtime.batch.results import open_results
from idesplat.runtime.batch.scenes import Scene, read_scenes
from idesplat.runtime.errors import InputError
from idesplat.runtime.system.files import LOCK_NAME
from scene_files import snapshot
from tiny_model import write_model

VARIABLES = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
BUCKET = "s3://captures"


@pytest.fixture(scope="module")
def bucket(scene: Path) -> Iterator[Any]:
    """A bucket with the scenes a and b, c without images, and a table."""
    moto = pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        host, port = server.get_host_and_port()
        for name, value in {**VARIABLES, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
            patch.setenv(name, value)
        store = fsspec.filesystem("s3", use_listings_cache=False)
        store.mkdir("captures")
        for name, views in {"a": (0, 1), "b": (1, 2)}.items():
            for view in views:
                store.put_file(str(scene / f"images/{view:03}.png"), f"captures/scenes/{name}/images/{view:03}.png")
            store.put_file(str(scene / "transforms.json"), f"captures/scenes/{name}/transforms.json")
        store.pipe_file("captures/scenes/c/notes.txt", b"no images")
        rows = [{"id": "a", "images": "scenes/a"}, {"id": "b", "images": f"{BUCKET}/scenes/b/images/*.png"}]
        rows[1]["cameras"] = "scenes/b/transforms.json"
        store.pipe_file("captures/scenes.jsonl", "\n".join(map(json.dumps, rows)).encode())
        yield store
    server.stop()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model") / "tiny.onnx")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "idesplat" / "inputs"


@pytest.mark.slow
def test_scenes_of_a_bucket_become_what_they_become_locally(bucket, model, scene, cache, tmp_path):
    out = f"{BUCKET}/results"
    summary = idesplat.batch(f"{BUCKET}/scenes", out, model=model)
    assert (summary.done, sorted(summary.failures)) == (2, ["c"])
    assert "no images" in summary.failures["c"]
    bucket.get("captures/scenes", str(tmp_path / "local"), recursive=True)
    idesplat.batch(tmp_path / "local", tmp_path / "out", model=model)
    for name in ("a", "b"):
        splats = bucket.cat_file(f"captures/results/{name}/scene.ply")
        assert splats == (tmp_path / "out" / name / "scene.ply").read_bytes()
    assert json.loads(bucket.cat_file("captures/results/summary.json"))["done"] == 2
    assert b"a/picture.jpg" in bucket.cat_file("captures/results/index.html")

    # Only what is missing or changed is done again: here a's splats are replaced, and b's are of another size.
    assert idesplat.batch(f"{BUCKET}/scenes", out, model=model).tried == 0
    bucket.pipe_file("captures/results/a/scene.ply", bytes(len(splats)))
    bucket.pipe_file("captures/results/b/scene.ply", b"cut short")
    assert idesplat.batch(f"{BUCKET}/scenes", out, model=model).tried == 2
    assert bucket.cat_file("captures/results/b/scene.ply") == splats

    # A table gives the same scenes by other paths, and another format replaces the files of the one before.
    again = idesplat.batch(f"{BUCKET}/scenes.jsonl", out, model=model, splat_format="splat")
    assert (again.scenes, again.done, again.tried) == (2, 2, 2)
    names = {Path(name).name for name in bucket.ls("captures/results/b")}
    assert names == {"scene.splat", "picture.jpg", "record.json"}


def test_the_inputs_hash_needs_no_download_and_changes_with_the_content(bucket, cache):
    def hashes() -> list[tuple[str, str]]:
        return StoredInputs(Scene("b", f"{BUCKET}/scenes/b"), InputCache(0)).hashes()

    before = hashes()
    assert sorted(name for name, _ in before) == ["images/001.png", "images/002.png", "transforms.json"]
    assert not cache.exists()
    content = bucket.cat_file("captures/scenes/b/transforms.json")
    bucket.pipe_file("captures/scenes/b/transforms.json", content + b" ")
    assert hashes() != before
    bucket.pipe_file("captures/scenes/b/transforms.json", content)
    assert hashes() == before


def test_the_cache_is_bounded_and_keeps_what_is_in_use(bucket, cache):
    first, second = (StoredInputs(Scene(name, f"{BUCKET}/scenes/{name}"), InputCache(1)) for name in "ab")
    with first.local() as local:
        images = Path(local.images, "images")
        assert sorted(path.name for path in images.iterdir()) == ["000.png", "001.png"]
        with second.local():
            assert len(os.listdir(cache)) == 2  # neither is removed
        inode = images.stat().st_ino
        with first.local() as same:
            assert Path(same.images, "images").stat().st_ino == inode  # not downloaded again
    with second.local():
        assert len(os.listdir(cache)) == 2  # b was there: no room was needed
    third = StoredInputs(Scene("t", f"{BUCKET}/scenes/a/images"), InputCache(1))
    with third.local():
        assert len(os.listdir(cache)) == 1


@pytest.mark.parametrize("used", "ab")
def test_what_was_not_used_for_the_longest_time_goes_first(bucket, cache, used):
    entries = {}
    for name in ("a", "b", "a/images"):
        with StoredInputs(Scene("x", f"{BUCKET}/scenes/{name}"), InputCache(1 << 30)).local():
            (new,) = set(cache.iterdir()) - set(entries.values())
            entries[name] = new
    third = entries.pop("a/images")
    shutil.rmtree(third)
    for entry in entries.values():
        os.utime(entry, (0, 0))
    with StoredInputs(Scene("x", f"{BUCKET}/scenes/{used}"), InputCache(1 << 30)).local():
        pass
    room = sum(int(entry.name.partition("-")[2]) for entry in (entries[used], third))
    with StoredInputs(Scene("x", f"{BUCKET}/scenes/a/images"), InputCache(room)).local():
        assert set(cache.iterdir()) == {entries[used], third}


def test_an_entry_whose_removal_was_cut_short_is_downloaded_again(bucket, cache):
    inputs = StoredInputs(Scene("a", f"{BUCKET}/scenes/a"), InputCache(1 << 30))
    with inputs.local():
        (entry,) = cache.iterdir()
    (entry / LOCK_NAME).unlink()
    next(entry.rglob("000.png")).unlink()
    with inputs.local() as local:
        assert len(list(Path(local.images, "images").iterdir())) == 2
        assert os.listdir(cache) == [entry.name]


def test_a_record_is_read_from_a_store_that_lost_it_as_none(bucket):
    results = open_results(f"{BUCKET}/nothing/here")
    assert results.read("record.json") is None
    assert not results.exists("record.json")
    results.remove("record.json")
    with pytest.raises(InputError, match="no such file or folder"):
        StoredInputs(Scene("x", f"{BUCKET}/nothing"), InputCache(0))
    with pytest.raises(InputError, match="no-such-bucket"):
        read_scenes("s3://no-such-bucket/scenes.csv")


def test_a_reconstructor_works_in_memory(scene, model, tmp_path):
    memory = fsspec.filesystem("memory")
    for name in ("images/000.png", "images/001.png", "transforms.json"):
        memory.pipe_file(f"/captures/a/{name}", (scene / name).read_bytes())
    reconstruct = idesplat.SceneReconstructor("memory://results", model=model, splat_format="spz")
    row = reconstruct({"id": "a", "images": "memory://captures/a"})
    assert (row["status"], row["splats"], row["error"]) == ("done", "memory://results/a/scene.spz", None)
    (tmp_path / "scene.spz").write_bytes(memory.cat_file("/results/a/scene.spz"))
    assert len(idesplat.read_splats(tmp_path / "scene.spz")) == row["gaussians"]
    before = memory.cat_file("/results/a/record.json")
    assert reconstruct({"id": "a", "images": "memory://captures/a"})["seconds"] == row["seconds"]
    assert memory.cat_file("/results/a/record.json") == before
    missing = reconstruct({"id": "b", "images": "memory://captures/b"})
    assert missing["status"] == "failed"
    assert missing["error"].startswith("memory://captures/b: no such file or folder")
    with pytest.raises(InputError, match="lives in one process"):
        idesplat.batch(scene.parent, "memory://results", model=model)


def test_nothing_of_others_is_replaced_in_a_store(scene, model):
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/owned/a/scene.ply", b"the user's own")
    row = idesplat.SceneReconstructor("memory://owned", model=model)({"id": "a", "images": scene})
    assert "did not write it" in row["error"]
    assert [name for name in memory.find("/owned")] == ["/owned/a/scene.ply"]


@pytest.mark.parametrize("size", (float("nan"), float("inf"), -1.0))
def test_a_cache_size_that_is_none_is_refused(size, scene, model, tmp_path):
    with pytest.raises(InputError, match="expected a number of gigabytes"):
        idesplat.SceneReconstructor(tmp_path, model=model, cache_gb=size)
    with pytest.raises(InputError, match="expected a number of gigabytes"):
        idesplat.batch(scene.parent, tmp_path, model=model, cache_gb=size)


def test_places(tmp_path):
    assert parse_place("file:///data/a%20b") == Path("/data/a b")
    assert parse_place("s3://bucket/a/") == "s3://bucket/a"
    assert beside("s3://bucket/lists/scenes.csv", "../a") == "s3://bucket/a"
    assert beside("s3://bucket/scenes.csv", "gs://other/a") == "gs://other/a"
    assert beside("s3://bucket/scenes.csv", "/data/a") == Path("/data/a")
    assert beside(tmp_path / "scenes.csv", "a") == tmp_path / "a"
    for wrong in ("http://host/a", "simplecache::s3://bucket/a", "s3:/bucket", "a\0b"):
        with pytest.raises(InputError, match=r"expected a local path|no file can have this name"):
            parse_place(wrong)


def test_a_local_cache_entry_holds_what_the_store_holds(bucket, cache, scene):
    with StoredInputs(Scene("a", f"{BUCKET}/scenes/a"), InputCache(1 << 30)).local() as local:
        files = {path.relative_to(local.images): content for path, content in snapshot(local.images).items() if content}
    for path, (content, _) in files.items():
        assert content == (scene / path).read_bytes()
    assert len(files) == 3
    shutil.rmtree(cache)
