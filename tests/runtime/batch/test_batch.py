"""`idesplat batch`: what is done is not done again, what changed is made anew, and kills leave nothing half done."""

import json
import multiprocessing
import shutil
import subprocess
import sys
import time
from pathlib import Path

import idesplat
import pytest
from conftest import run_command
from idesplat.runtime.cli import batch
from idesplat.runtime.system.files import SCRATCH_PREFIX
from killed_workers import killing_workers
from scene_files import snapshot
from tiny_model import write_model

NAMES = ("a", "b", "c", "d")
SECONDS = 60
POLL_S = 0.001
MEASURED = {"timings": 0, "seconds": 0, "peak_memory": 0}
BATCH = "from idesplat.runtime.cli.launch import idesplat; idesplat()"

pytestmark = [pytest.mark.slow, pytest.mark.posix]


@pytest.fixture(scope="module")
def given(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Four scenes and one without images, and a model."""
    folder = tmp_path_factory.mktemp("batch")
    for number, name in enumerate(NAMES):
        (folder / "scenes" / name / "images").mkdir(parents=True)
        for view in (number, number + 1):
            shutil.copy(scene / "images" / f"{view:03}.png", folder / "scenes" / name / "images")
        shutil.copy(scene / "transforms.json", folder / "scenes" / name)
    (folder / "scenes" / "empty").mkdir()
    return folder / "scenes", write_model(folder / "tiny.onnx")


@pytest.fixture(scope="module")
def undisturbed(given: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run to which nothing happened."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    summary = idesplat.batch(given[0], out, model=given[1], workers=2)
    assert (summary.scenes, summary.tried, summary.done, list(summary.failures)) == (5, 5, 4, ["empty"])
    return out


def records(text: str) -> dict[str, dict]:
    return {record["id"]: record for record in map(json.loads, text.splitlines())}


def same_splats(out: Path, other: Path, name: str) -> bool:
    return (out / name / "scene.ply").read_bytes() == (other / name / "scene.ply").read_bytes()


def test_again_does_what_is_missing_or_changed_and_nothing_else(given, undisturbed, tmp_path, capsys):
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    shutil.copytree(given[0], scenes)
    shutil.copytree(undisturbed, out)
    arguments = (scenes, "--out", out, "--model", given[1])
    before = snapshot(tmp_path)
    assert "Traceback" in (out / "empty" / "error.txt").read_text()
    assert run_command(batch.main, *arguments) == 3  # one failed, and stays so
    assert capsys.readouterr() == ("", "")
    after = snapshot(tmp_path)
    changed = {path for path in after if after[path] != before.get(path)}
    assert changed <= {out / "summary.json", out / "index.html"}

    whole = (out / "a" / "scene.ply").read_bytes()
    (out / "a" / "scene.ply").write_bytes(whole[:100])
    (out / "b" / "record.json").unlink()
    for name in ("scene.ply", "picture.jpg"):
        (out / "b" / name).unlink()
    shutil.copy(scenes / "a" / "images" / "000.png", scenes / "c" / "images" / "002.png")
    assert run_command(batch.main, *arguments, "--retry-failed") == 3
    tried = records(capsys.readouterr().out)
    assert {name: record["status"] for name, record in tried.items()} == {
        **dict.fromkeys(("a", "b", "c"), "done"),
        "empty": "failed",
    }
    assert same_splats(out, undisturbed, "a")
    assert same_splats(out, undisturbed, "b")
    assert not same_splats(out, undisturbed, "c")
    assert json.loads((out / "summary.json").read_text())["tried"] == 4


def test_the_scene_of_a_killed_worker_is_done_again_and_fails_the_second_time(given, undisturbed, tmp_path):
    out = tmp_path / "out"
    with killing_workers(out, lambda: [multiprocessing.active_children()[0].pid]) as killed:
        summary = idesplat.batch(given[0], out, model=given[1])
    assert killed == ["b", "c", "c"]
    assert (summary.done, sorted(summary.failures)) == (3, ["c", "empty"])
    record = json.loads((out / "c" / "record.json").read_text())
    assert record["status"] == "failed"
    assert "killed twice" in record["error"]
    assert not (out / "c" / "scene.ply").exists()
    assert all(same_splats(out, undisturbed, name) for name in ("a", "b", "d"))


def test_after_the_driver_is_killed_the_same_command_does_the_rest(given, undisturbed, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [given[0], "--out", out, "--model", given[1], "--workers", 2]
    driver = subprocess.Popen(
        [sys.executable, "-c", BATCH, "batch", *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )
    first = json.loads(driver.stdout.readline())
    children = Path(f"/proc/{driver.pid}/task/{driver.pid}/children")
    workers = [int(pid) for pid in children.read_text().split()] if children.exists() else []
    driver.kill()
    driver.communicate(timeout=SECONDS)
    wait_for_end(workers)

    assert run_command(batch.main, *arguments) == 3
    assert first["id"] not in records(capsys.readouterr().out)
    for name in NAMES:
        record, expected = (json.loads((folder / name / "record.json").read_text()) for folder in (out, undisturbed))
        assert same_splats(out, undisturbed, name)
        assert {**record, **MEASURED} == {**expected, **MEASURED}
    assert not [path for path in snapshot(out) if path.name.startswith(SCRATCH_PREFIX)]


def wait_for_end(processes: list[int]) -> None:
    """Wait until none of the processes runs; a zombie does not."""
    deadline = time.monotonic() + SECONDS
    while any(runs(process) for process in processes):
        assert time.monotonic() < deadline, "workers outlive their driver"
        time.sleep(POLL_S)


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
