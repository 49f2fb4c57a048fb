"""The command `python -P -m idesplat.tools.benchmark.batch_kills`: a batch on Ray that is killed again and again.

At random moments a signal goes to the driver, an actor or Ray's raylet, and the same command is started again, until so
many kills have met a process. Then every scene must be there once, whole, and equal to that of an undisturbed run.
"""

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError
from ..processes import descendants

VICTIMS = ("driver", "actor", "raylet")
SIGNALS = (signal.SIGKILL, signal.SIGTERM)
BATCH = "from idesplat.runtime.cli.launch import idesplat; idesplat()"
ACTOR, RAYLET = "ray::_Actor", "raylet/raylet"
LONGEST = 600.0  # seconds that a run may take
LATEST = 15.0  # seconds after a process started, at which it is killed at the latest
POLL = 0.05


@command("batch kills")
def kills(
    scenes: Annotated[Path, typer.Argument(help="Folder of scene folders, or a table, as of `idesplat batch`.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results of both runs; new.")],
    moments: Annotated[int, typer.Option(help="How many kills.", min=1)] = 40,
    seed: Annotated[int, typer.Option(help="Of the random moments.")] = 0,
    model: Annotated[Path | None, typer.Option(help="As of `idesplat batch`.")] = None,
) -> None:
    """Kill a batch on Ray at random moments, and compare its results with those of an undisturbed run."""
    check_kills(scenes, out, moments, seed, model, tell=say)


def check_kills(
    scenes: Path, out: Path, moments: int, seed: int, model: Path | None = None, tell: Callable[[str], object] = str
) -> None:
    """Raise AssertionError unless a batch that was killed at random moments gives what an undisturbed one gives.

    Raises InputError if the undisturbed one fails.
    """
    arguments = ["batch", str(scenes), "--quality", "fast", "--workers", "2", "--threads", "1"]
    arguments += ["--model", str(model)] * (model is not None)
    status = _start(arguments, out / "undisturbed").wait(LONGEST)
    if status:
        raise InputError(f"{scenes}: without kills the batch ends with status {status}; give scenes that all succeed")
    expected = results(out / "undisturbed")
    assert expected, "the undisturbed run has no results"
    rng, done, runs = random.Random(seed), 0, 0
    while done < moments:
        runs += 1
        # Each run starts with a few scenes missing, so that there is work to be killed.
        for name in rng.sample(sorted(expected), min(len(expected), 3)):
            (out / "disturbed" / name / "record.json").unlink(missing_ok=True)
            (out / "disturbed" / name / "scene.ply").unlink(missing_ok=True)
            (out / "disturbed" / name / "picture.jpg").unlink(missing_ok=True)
        driver = _start([*arguments, "--engine", "ray", "--retry-failed"], out / "disturbed")
        done += _disturb(driver, rng, tell)
    last = _start([*arguments, "--engine", "ray", "--retry-failed"], out / "disturbed")
    assert last.wait(LONGEST) == 0, "the last run, which nothing disturbed, failed"
    found = results(out / "disturbed")
    assert found == expected, sorted(name for name in expected if found.get(name) != expected[name])
    tell(f"{done} kills in {runs} runs: all {len(found)} scenes are there once, whole, and equal to an undisturbed run")


def results(out: Path) -> dict[str, str]:
    """The hash of each scene's splats, after a check that its record is done and that no other file stands there."""
    found = {}
    for record_path in sorted(out.glob("*/record.json")):
        folder, record = record_path.parent, json.loads(record_path.read_text())
        names = {path.name for path in folder.iterdir()}
        assert record["status"] == "done", record
        assert names == {"record.json", *record["files"]}, (folder, names)
        for name, described in record["files"].items():
            assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == described["sha256"], folder / name
        found[folder.name] = record["files"]["scene.ply"]["sha256"]
    return found


def _start(arguments: list[str], out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-P", "-c", BATCH, *arguments, "--out", str(out)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def _disturb(driver: subprocess.Popen[bytes], rng: random.Random, tell: Callable[[str], object]) -> int:
    """Send signals at random moments until the driver has ended; how many met a process.

    A moment is counted from when there is such a process: Ray and its actors need seconds to start.
    """
    met, until = 0, time.monotonic() + LONGEST
    victim, moment = rng.choice(VICTIMS), None
    while driver.poll() is None:
        assert time.monotonic() < until, "a run does not end"
        found = driver.pid if victim == "driver" else next(_children(driver.pid, victim), None)
        if found is not None and moment is None:
            moment = time.monotonic() + rng.uniform(0, LATEST)
        elif found is not None and moment is not None and time.monotonic() >= moment:
            number = rng.choice(SIGNALS)
            os.kill(found, number)
            met += 1
            tell(f"{number.name} to the {victim}")
            victim, moment = rng.choice(VICTIMS), None
        time.sleep(POLL)
    return met


def _children(driver: int, victim: str) -> Iterator[int]:
    """The processes below the driver that are an actor or the raylet."""
    for process, words in descendants(driver).items():
        if words.startswith(ACTOR) if victim == "actor" else RAYLET in words.partition("\0")[0]:
            yield process


def main() -> None:
    """Run the command."""
    run(kills)


if __name__ == "__main__":
    main()
