"""The command `python -P -m idesplat.tools.benchmark.batch`: what a batch of scenes costs beyond the model's own time.

Scenes of three views are synthetic rooms, a few of which are read again and again. Printed are wall time beside the sum
of the model's own time and decoding, throughput for each worker, the share of time that workers waited for the engine,
and the workers' memory at the tenth scene and at the last.
"""

import json
import resource
import statistics
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ...runtime.batch.run import Engine, batch
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError
from ...runtime.inference.session import SessionConfig
from ..synthetic.make_scene import make_scene

VIEWS = 3
HEIGHT, WIDTH = 240, 320
ROOMS = 6
SETTLED = 10  # scenes of a worker after which its memory is taken for settled
MB = 10**6


@command("benchmark batch")
def measure(
    folder: Annotated[Path, typer.Argument(help="Folder for scenes and results; results must not be there yet.")],
    scenes: Annotated[int, typer.Option(help="How many.", min=2)] = 200,
    engine: Annotated[Engine, typer.Option(help="What runs the workers.")] = Engine.LOCAL,
    workers: Annotated[int, typer.Option(help="Each takes one thread.", min=1)] = 2,
) -> None:
    """Reconstruct synthetic scenes and print what the batch costs beyond the model's own time."""
    out = folder / f"{engine}-{workers}-{scenes}"
    if out.exists():
        raise InputError(f"{out}: results are there already, and what is done is not measured; choose a new folder")
    table = write_scenes(folder, scenes)
    records: list[dict[str, Any]] = []
    ended: list[float] = []

    def collect(record: dict[str, Any]) -> None:
        ended.append(time.perf_counter())
        records.append(record)

    started = time.perf_counter()
    batch(
        table,
        out,
        engine=engine,
        workers=workers,
        options={"quality": "fast", "views": VIEWS},
        session=SessionConfig(threads=1),
        on_record=collect,
    )
    if any("error" in record for record in records):
        raise SystemExit(next(record["error"] for record in records if "error" in record))
    wall = time.perf_counter() - started
    starting = ended[0] - started - records[0]["seconds"]
    found = summarise(records, wall, starting, workers)
    if engine is Engine.LOCAL:  # Ray's actors are not this process's children
        found["cpu_seconds_per_scene"] = _cpu_of_children() / len(records)
    say(*json.dumps(found, indent=2).splitlines())


def write_scenes(folder: Path, scenes: int) -> Path:
    """The table of scenes, which share a few rooms; these are made where they are missing."""
    for room in range(ROOMS):
        place = folder / "rooms" / str(room)
        if not (place / "transforms.json").exists():
            make_scene(place, seed=room, views=VIEWS, height=HEIGHT, width=WIDTH)
    table = folder / f"scenes-{scenes}.jsonl"
    rows = [{"id": f"{number:07}", "images": f"rooms/{number % ROOMS}"} for number in range(scenes)]
    table.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return table


def summarise(records: list[dict[str, Any]], wall: float, starting: float, workers: int) -> dict[str, Any]:
    """What was measured. wall: seconds of the batch. starting: until a worker got the first scene."""
    # The first scene of each worker opens the model, and compiles the rasteriser where that was not done before.
    settled = records[workers * SETTLED :]
    work = sum(record["timings"]["model"] + record["timings"]["prepare"] for record in records) / workers
    busy = sum(record["seconds"] for record in records) / workers
    steps = {name: statistics.median(record["timings"][name] for record in records) for name in records[0]["timings"]}
    return {
        "scenes": len(records),
        "workers": workers,
        "wall_seconds": wall,
        "starting_seconds": starting,
        "model_and_decoding_seconds": work,
        "wall_without_starting_over_model_and_decoding": (wall - starting) / work,
        "share_waiting_for_engine": 1 - busy / (wall - starting),
        "scenes_per_minute_and_worker": 60 * len(records) / (wall - starting) / workers,
        "median_seconds": {**steps, "scene": statistics.median(record["seconds"] for record in records)},
        "peak_mb_at_tenth": _peak(records[workers * (SETTLED - 1) : workers * SETTLED]),
        "peak_mb_at_end": _peak(settled[-workers:]),
        "peak_mb_after_tenth": _peak(settled),
    }


def _peak(records: list[dict[str, Any]]) -> float | None:
    return max((record["peak_memory"] / MB for record in records if record["peak_memory"]), default=None)


def _cpu_of_children() -> float:
    """CPU seconds of the workers, which have ended; of a shared machine it tells more than wall time."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run the command."""
    run(measure)


if __name__ == "__main__":
    main()
