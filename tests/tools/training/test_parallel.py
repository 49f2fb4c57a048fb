"""Data-parallel training: the same steps with one and two processes, and no process that outlives the run."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from idesplat.runtime.errors import InputError
from idesplat.tools.training import cli
from idesplat.tools.training.options import Resources
from idesplat.tools.training.parallel import ProcessGroup, mean_entries, spawn_workers
from idesplat.tools.training.run_files import CHECKPOINT, LOG
from idesplat.tools.training.trainer import train
from test_train import SETTINGS, SMALL

pytestmark = pytest.mark.slow

TWO_STEPS = replace(SETTINGS, curriculum=False, steps=2, batch=2)


def trained(folder: Path, processes: int) -> tuple[dict[str, torch.Tensor], list[dict[str, float]]]:
    folder.mkdir()
    train(TWO_STEPS, folder, config=SMALL, resources=Resources(processes=processes), save_every=1e9, validate_every=10)
    entries = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    return torch.load(folder / CHECKPOINT, weights_only=True)["training"]["weights"], entries


def test_two_processes_make_the_same_steps_as_one(tmp_path: Path) -> None:
    """The same gradients up to the order of summation, and the same metrics."""
    alone, entries = trained(tmp_path / "alone", 1)
    shared, entries_shared = trained(tmp_path / "shared", 2)
    for entry, other in zip(entries, entries_shared, strict=True):
        assert other["loss"] == pytest.approx(entry["loss"], rel=1e-3)
        assert other["gradient"] == pytest.approx(entry["gradient"], rel=1e-2)
    difference = sum(float((alone[name] - other).abs().sum()) for name, other in shared.items())
    total = sum(float(value.abs().sum()) for value in alone.values())
    assert difference < 1e-3 * total
    # The second step starts from updated weights, so it shows whether all processes made the same update.
    assert len(entries_shared) == 2


def test_shards_cover_the_batch() -> None:
    shards = [list(ProcessGroup(rank, 3).shard(8)) for rank in range(3)]
    assert shards == [[0, 3, 6], [1, 4, 7], [2, 5]]
    assert list(ProcessGroup().shard(3)) == [0, 1, 2] and ProcessGroup().is_main and not ProcessGroup(1, 2).is_main


def test_metrics_are_averaged_over_the_scenes_that_have_them() -> None:
    assert mean_entries([{"loss": 1.0, "psnr": 20.0}, {"loss": 3.0}]) == {"loss": 2.0, "psnr": 20.0}


def test_more_processes_than_scenes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="more than the 1 scenes of a step"):
        cli.train(out=tmp_path / "run", batch=1, processes=2)


def test_killed_run_leaves_no_process_behind(tmp_path: Path) -> None:
    """SIGKILL for rank 0: the other process ends at its next exchange."""
    options = ["--steps=500", "--size=64", "--batch=2", "--processes=2", "--objective=depth"]
    command = [sys.executable, "-m", "idesplat.tools.training.cli", f"--out={tmp_path}", *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        while not (tmp_path / LOG).exists() or not (tmp_path / LOG).read_text():
            assert process.poll() is None
            time.sleep(0.1)
        process.send_signal(signal.SIGKILL)
        process.wait()
        while _members(process.pid):
            time.sleep(0.1)
    finally:
        if _members(process.pid):
            os.killpg(process.pid, signal.SIGKILL)


def _members(group: int) -> bool:
    """Whether a process group has a member left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _fail(_: ProcessGroup) -> None:
    raise InputError("frame.jpg: cannot be decoded")


def test_the_error_of_another_process_is_that_of_the_run() -> None:
    with pytest.raises(InputError, match=r"^frame\.jpg: cannot be decoded$"), spawn_workers(2, _fail):
        ProcessGroup(0, 2).gather([{"loss": 1.0}])


def test_ended_process_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("Connection closed by peer\nmore")

    monkeypatch.setattr(torch.distributed, "all_gather_object", fail)
    with pytest.raises(InputError, match=r"ended \(Connection closed by peer\); repeat the command"):
        ProcessGroup(0, 2).gather([])
