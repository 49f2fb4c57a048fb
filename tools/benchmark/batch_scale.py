"""The command `python -P -m idesplat.tools.benchmark.batch_scale`: what the driver of a large batch costs.

The driver's own work is done for a table of so many scenes with one measured record in place of their reconstruction.
How fast it can hand out scenes is measured on a real Ray with as many calls in flight as there would be workers. What a
cluster would take is calculated from these numbers.
"""

import json
import pickle
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ...runtime.batch.index import Index
from ...runtime.batch.ray_engine import connected
from ...runtime.batch.run import Summary
from ...runtime.batch.scenes import read_scenes
from ...runtime.batch.worker import Outcome
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say
from ...runtime.system.memory import peak_bytes, reset_peak

CALLS = 3000  # through Ray
MB, GB = 10**6, 10**9
HOUR = 3600


@command("benchmark scale")
def scale(
    folder: Annotated[Path, typer.Argument(help="Folder for the table of scenes.")],
    record: Annotated[Path, typer.Argument(help="record.json of a scene that `idesplat batch` made.")],
    scenes: Annotated[int, typer.Option(help="How many.", min=2)] = 1_000_000,
    workers: Annotated[int, typer.Option(help="Of one core each.", min=1)] = 1000,
) -> None:
    """Measure the driver of a batch, and print what a cluster would take for it."""
    given = json.loads(record.read_text())
    table = folder / "many.jsonl"
    folder.mkdir(parents=True, exist_ok=True)
    with table.open("w") as file:
        for number in range(scenes):
            row = {"id": f"scene-{number:09}", "images": f"s3://captures/scenes/scene-{number:09}"}
            file.write(json.dumps(row) + "\n")
    found = {"scenes": scenes, "workers": workers, **drive(table, given), **hand_out(workers, given)}
    table.unlink()
    say(*json.dumps(found | cluster(found, given), indent=2).splitlines())


def drive(table: Path, record: dict[str, Any]) -> dict[str, float]:
    """The driver's own work: the table is read, and each scene has this record."""
    before = peak_bytes() or 0
    reset_peak()
    started = time.perf_counter()
    scenes = read_scenes(table)
    checked, checked_peak = time.perf_counter(), peak_bytes() or 0
    reset_peak()
    summary, index = Summary(len(scenes)), Index()
    for scene in scenes:
        outcome = Outcome({**record, "id": scene.id}, True)
        summary.add(outcome, 0.0)
        index.add(outcome.record)
        json.dumps(outcome.record)
    page = index.page(summary.describe())
    ended = time.perf_counter()
    return {
        "driver_mb_before": before / MB,
        "driver_mb_while_checking_ids": checked_peak / MB,
        "driver_mb_while_running": (peak_bytes() or 0) / MB,
        "index_page_mb": len(page) / MB,
        "seconds_to_check_the_table": checked - started,
        "driver_seconds_per_scene": (ended - checked) / len(scenes),
    }


def hand_out(in_flight: int, record: dict[str, Any]) -> dict[str, float]:
    """How many calls a second the driver's loop handles with so many in flight, to one actor that does nothing."""

    class Nothing:
        def run(self, scene: str) -> Outcome:
            return Outcome({**record, "id": scene}, True)

    with connected(None, 1) as ray:
        actor = ray.remote(Nothing).remote()
        ray.get(actor.run.remote(""))
        running = {actor.run.remote("scene"): None for _ in range(in_flight)}
        started = time.perf_counter()
        for _ in range(CALLS):
            (done,), _ = ray.wait(list(running), num_returns=1)
            del running[done]
            ray.get(done)
            running[actor.run.remote("scene")] = None
        return {"scenes_per_second_through_ray": CALLS / (time.perf_counter() - started)}


def cluster(found: dict[str, Any], record: dict[str, Any]) -> dict[str, Any]:
    """What the cluster takes, from the measured numbers. A worker is one core."""
    scenes, seconds = found["scenes"], record["seconds"]
    results = sum(described["bytes"] for described in record["files"].values())
    message = len(pickle.dumps(Outcome(record, True)))
    hours = scenes * seconds / found["workers"] / HOUR
    return {
        "seconds_per_scene": seconds,
        "hours": hours,
        "scenes_per_second": found["workers"] / seconds,
        "bytes_through_ray_per_scene": message,
        "gb_through_ray": scenes * message / GB,
        "result_mb_per_scene": results / MB,
        "result_tb": scenes * results / MB / MB,
        "result_gb_per_second": found["workers"] / seconds * results / GB,
        "records_gb": scenes * len(json.dumps(record, indent=2)) / GB,
    }


def main() -> None:
    """Run the command."""
    run(scale)


if __name__ == "__main__":
    main()
