"""Many scenes in one function: what `idesplat batch` does, as a library."""

import json
import os
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..inference.named_models import find_model
from ..inference.providers import CPU
from ..inference.session import DEFAULT, SessionConfig, usable_cores
from ..system.progress import progress
from .cache import DEFAULT_GB
from .index import Index
from .places import Place, join, parse_place
from .pool import run_in_pool
from .ray_engine import run_on_ray
from .records import PLY, Status, check_own, splats_name, write_text
from .results import open_results
from .scenes import Scenes, parse_shard, read_scenes
from .worker import Outcome, Settings, check_settings, make_settings

MAX_LISTED = 1000  # failures in a summary


class Engine(StrEnum):
    """What runs the workers. LOCAL: processes of this machine. RAY: actors of Ray, here or on a cluster."""

    LOCAL = "local"
    RAY = "ray"


@dataclass
class Summary:
    """What a run has done.

    scenes: of this run, of its shard where it has one. done, failed: scenes in these states, from this run or earlier.
    tried: by this run. left: scenes that it did not get to, after `max_failures`. seconds: of the run.
    failures: the error of each failed scene, by id; of the first thousand.
    """

    scenes: int
    done: int = 0
    failed: int = 0
    tried: int = 0
    left: int = 0
    seconds: float = 0.0
    failures: dict[str, str] = field(default_factory=dict)

    def describe_pace(self) -> str:
        """The throughput so far, and the failures."""
        pace = f"{60 * self.tried / max(self.seconds, 1e-9):.3g} scenes/min" if self.tried else ""
        return ", ".join(filter(None, (pace, f"{self.failed} failed" if self.failed else "")))

    def describe(self) -> str:
        """The counts, in words."""
        left = f", {self.left} left" if self.left else ""
        return f"{self.done} of {self.scenes} scenes done, {self.failed} failed{left}"

    def add(self, outcome: Outcome, seconds: float) -> None:
        """Count a scene."""
        record, self.seconds = outcome.record, seconds
        self.tried += outcome.tried
        if record["status"] == Status.DONE:
            self.done += 1
        else:
            self.failed += 1
            if len(self.failures) < MAX_LISTED:
                self.failures[record["id"]] = record["error"]


def batch(
    scenes: Path | str,
    out: Path | str,
    *,
    engine: str = Engine.LOCAL,
    address: str | None = None,
    model: Path | str | None = None,
    options: Mapping[str, Any] | None = None,
    splat_format: str = PLY,
    workers: int = 1,
    provider: str = CPU,
    session: SessionConfig = DEFAULT,
    shard: str | None = None,
    retry_failed: bool = False,
    max_failures: int | None = None,
    cache_gb: float = DEFAULT_GB,
    overwrite: bool = False,
    on_record: Callable[[dict[str, Any]], None] | None = None,
) -> Summary:
    """Reconstruct the scenes that are missing or changed into `out/<id>/scene.ply`, in many processes.

    scenes: a folder of scene folders, or a .jsonl or .csv with the columns id, images, cameras and options, which go
    before `options`. A scene is done when `out/<id>/record.json`, which is written last, holds the hash of its images,
    cameras, options, model and version. A failed one is recorded, its traceback in `error.txt`, and the rest goes on;
    it is tried again when its inputs change or with `retry_failed`. The run stops after `max_failures` of its own.
    `scenes`, `out` and what a table names are paths, or URLs of stores such as s3://bucket/scenes. Of inputs from
    stores at most `cache_gb` are kept in the cache folder.
    engine: "local" for a pool of processes, "ray" for actors of Ray, which starts here by itself unless `address` names
    a cluster. model: as in `reconstruct`. options: keywords of `reconstruct` and fields of `FilterOptions`.
    splat_format: "ply", "spz" or another suffix of splat files.
    workers: processes, each with an opened model. session: its `threads` are those of each worker; by default its share
    of the cores, or one on a cluster.
    shard: "I/N", the part I of N, from 1. overwrite: replace files in `out` that are no results of a batch.
    on_record: called with the record of each scene that was tried.
    Processes import the main module again: a script must call this under `if __name__ == "__main__":`.
    Raises InputError for invalid arguments, a model that cannot be opened, or a file that would be replaced.
    """
    started = time.perf_counter()
    target = parse_place(out)
    source = parse_place(scenes)
    if engine == Engine.RAY:  # its actors need not have this process's current folder
        source, target = (place.absolute() if isinstance(place, Path) else place for place in (source, target))
    chosen = read_scenes(source).of_shard(shard)
    _check(engine, address, workers, [chosen.source, target])
    check_settings(options, provider, splat_format, cache_gb)
    if isinstance(target, Path):
        _check_local(chosen, target, None if overwrite else splats_name(splat_format))
    threads = session.threads or (1 if address else max(1, usable_cores() // workers))
    settings = make_settings(
        find_model(model).absolute(),
        target,
        options=options,
        splat_format=splat_format,
        provider=provider,
        session=replace(session, threads=threads),
        retry_failed=retry_failed,
        cache_gb=cache_gb,
        overwrite=overwrite,
    )
    summary, index = Summary(len(chosen)), Index()
    failures = 0
    workers = min(workers, max(len(chosen), 1))
    with closing(_run(Engine(engine), chosen, workers, threads, settings, address)) as outcomes:
        for outcome in progress(outcomes, "reconstructing scenes", len(chosen), summary.describe_pace):
            summary.add(outcome, time.perf_counter() - started)
            index.add(outcome.record)
            if outcome.tried and on_record is not None:
                on_record(outcome.record)
            failures += outcome.tried and outcome.record["status"] == Status.FAILED
            if max_failures is not None and failures >= max_failures:
                break
    summary.left = summary.scenes - summary.done - summary.failed
    results = open_results(target)
    write_text(results, summary_name(shard), json.dumps(asdict(summary), indent=2) + "\n")
    write_text(results, index_name(shard), index.page(summary.describe()))
    return summary


def summary_name(shard: str | None) -> str:
    """The name of the summary of a run, or of one shard."""
    return f"summary{_part(shard)}.json"


def index_name(shard: str | None) -> str:
    """The name of the page that shows a run's scenes, or those of one shard."""
    return f"index{_part(shard)}.html"


def _part(shard: str | None) -> str:
    return "-{}-of-{}".format(*parse_shard(shard)) if shard else ""


def _run(
    engine: Engine, scenes: Scenes, workers: int, threads: int, settings: Settings, address: str | None
) -> Generator[Outcome, None, None]:
    if engine is Engine.RAY:
        return run_on_ray(scenes, workers, threads, settings, address)
    return run_in_pool(scenes, workers, threads, settings)


def _check(engine: str, address: str | None, workers: int, places: list[Place]) -> None:
    """Raise InputError for invalid arguments."""
    if engine not in tuple(Engine):
        raise InputError(f"--engine {engine}: expected {' or '.join(Engine)}")
    if address is not None and engine != Engine.RAY:
        raise InputError(f"--address {address}: is of a Ray cluster; add --engine ray")
    if workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more")
    for place in places:
        if isinstance(place, str) and place.startswith("memory:"):
            raise InputError(f"{place}: lives in one process, and a batch has several; use SceneReconstructor")


def _check_local(scenes: Scenes, out: Path, splats: str | None) -> None:
    """Raise InputError where results would stand among the images, or would replace files that no batch wrote.

    splats: the name of the splat files; None where anything may be replaced.
    """
    real = os.path.realpath(out)
    if isinstance(scenes.source, Path) and scenes.source.is_dir():
        _check_outside(out, real, scenes.source)
    for scene in scenes:
        if isinstance(scene.images, Path):
            _check_outside(out, real, scene.images)
            if Path(os.path.realpath(scene.images)).is_relative_to(os.path.join(real, scene.id)):
                raise InputError(
                    f"--out {out}: the results of {scene.id} would stand beside its images; choose another"
                )
        if splats is not None:
            check_own(open_results(join(out, scene.id)), out / scene.id, splats)


def _check_outside(out: Path, real: str, folder: Path) -> None:
    if Path(real).is_relative_to(os.path.realpath(folder)):
        raise InputError(f"--out {out}: lies in {folder}, which is an input; choose a folder elsewhere")
