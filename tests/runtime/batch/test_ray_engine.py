"""Batches on a real Ray, which is started once for all tests here."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import idesplat
import pytest
from conftest import run_command
from idesplat.runtime.batch.ray_engine import connected
from idesplat.runtime.batch.run import Engine
from idesplat.runtime.cli import batch
from idesplat.tools.processes import descendants
from killed_workers import killing_workers
from tiny_model import NETWORK, write_model

NAMES = ("a", "b", "c")
LOOPBACK = ("0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000")
LISTENING = "0A"

pytestmark = [pytest.mark.slow, pytest.mark.posix]


@pytest.fixture(scope="module")
def given(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Three scenes and one without images, and a model."""
    folder = tmp_path_factory.mktemp("ray")
    for number, name in enumerate(NAMES):
        (folder / "scenes" / name / "images").mkdir(parents=True)
        for view in (number, number + 1):
            shutil.copy(scene / "images" / f"{view:03}.png", folder / "scenes" / name / "images")
        shutil.copy(scene / "transforms.json", folder / "scenes" / name)
    (folder / "scenes" / "empty").mkdir()
    return folder / "scenes", write_model(folder / "tiny.onnx")


@pytest.fixture(scope="module", autouse=True)
def ray() -> Iterator[object]:
    """Ray as the command starts it, with two CPUs."""
    with connected(None, 2) as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed(given: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the local engine."""
    out = tmp_path_factory.mktemp("local") / "out"
    assert idesplat.batch(given[0], out, model=given[1]).done == len(NAMES)
    return out


def same(out: Path, other: Path, names: tuple[str, ...] = NAMES) -> bool:
    files = [Path(name, "scene.ply") for name in names]
    return all((out / file).read_bytes() == (other / file).read_bytes() for file in files)


def test_results_are_those_of_the_local_engine_and_ray_prints_nothing(given, undisturbed, tmp_path, capfd):
    arguments = (given[0], "--out", tmp_path / "out", "--model", given[1], "--engine", "ray", "--workers", 2)
    assert run_command(batch.main, *arguments) == batch.SOME_FAILED
    printed = capfd.readouterr()
    records = {record["id"]: record["status"] for record in map(json.loads, printed.out.splitlines())}
    assert records == {**dict.fromkeys(NAMES, "done"), "empty": "failed"}
    assert printed.err == ""
    assert same(tmp_path / "out", undisturbed)
    assert run_command(batch.main, *arguments) == batch.SOME_FAILED
    assert capfd.readouterr() == ("", "")


def actors() -> list[int]:
    return [process for process, words in descendants(os.getpid()).items() if words.startswith("ray::_Actor")]


def test_the_scene_of_a_killed_actor_is_done_again_and_fails_the_second_time(given, undisturbed, tmp_path):
    out = tmp_path / "out"
    with killing_workers(out, actors) as killed:
        summary = idesplat.batch(given[0], out, model=given[1], engine=Engine.RAY)
    assert killed == ["b", "c", "c"]
    assert (summary.done, sorted(summary.failures)) == (2, ["c", "empty"])
    assert "killed twice" in json.loads((out / "c" / "record.json").read_text())["error"]
    assert not (out / "c" / "scene.ply").exists()
    assert same(out, undisturbed, ("a", "b"))


def test_a_model_that_cannot_be_opened_ends_the_run(given, tmp_path):
    model = write_model(tmp_path / "wrong.onnx", NETWORK.replace("Abs (means)", "Absent (means)"))
    with pytest.raises(idesplat.InputError, match="ONNX Runtime cannot load it"):
        idesplat.batch(given[0], tmp_path / "out", model=model, engine=Engine.RAY)


def test_ray_listens_on_the_loopback_address_alone():
    own = {link for process in descendants(os.getpid()) for link in open_files(process)}
    listening = []
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        for line in table.read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and f"socket:[{fields[9]}]" in own:
                listening.append(fields[1].partition(":")[0])
    assert listening
    assert set(listening) <= set(LOOPBACK)


def open_files(process: int) -> list[str]:
    try:
        return [os.readlink(path) for path in Path(f"/proc/{process}/fd").iterdir()]
    except (FileNotFoundError, PermissionError):
        return []


def test_rows_are_mapped_by_actors(given, undisturbed, tmp_path, ray):
    """As Ray Data does: the class is sent to actors, and rows to its calls."""
    from ray.util import ActorPool

    actor = ray.remote(num_cpus=1)(idesplat.SceneReconstructor)
    actors = [actor.remote(tmp_path / "out", model=given[1]) for _ in range(2)]
    rows = [{"id": name, "images": str(given[0] / name)} for name in (*NAMES, "empty")]
    found = list(ActorPool(actors).map(lambda actor, row: actor.__call__.remote(row), rows))
    assert [(row["id"], row["status"]) for row in found] == [*((name, "done") for name in NAMES), ("empty", "failed")]
    assert same(tmp_path / "out", undisturbed)
