"""Many scenes in one function: what `idesplat batch` does, as a library."""

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..inference.model_files import read_model
from ..inference.named_models import find_model
from ..inference.providers import CPU, candidates
from ..inference.session import DEFAULT, SessionConfig, usable_cores
from ..splats.filtering import FilterOptions
from ..system.files import atomic_write, make_folder
from ..system.progress import progress
from .pool import run_in_pool
from .records import RECORD, SPLATS, Status, model_sha256, read_record
from .scenes import FILTERS, OPTIONS, Scene, check_local, read_scenes
from .worker import Outcome, Settings

LOCAL = "local"


@dataclass
class Summary:
    """What a run has done.

    scenes: of this run, of its shard where it has one. done, failed: scenes in these states, from this run or earlier.
    tried: by this run. left: scenes that it did not get to, after `max_failures`. seconds: of the run.
    failures: the error of each failed scene, by id.
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

    def add(self, outcome: Outcome, seconds: float) -> None:
        """Count a scene."""
        record, self.seconds = outcome.record, seconds
        self.tried += outcome.tried
        if record["status"] == Status.DONE:
            self.done += 1
        else:
            self.failed += 1
            self.failures[record["id"]] = record["error"]


def batch(
    scenes: Path | str,
    out: Path | str,
    *,
    engine: str = LOCAL,
    model: Path | str | None = None,
    options: Mapping[str, Any] | None = None,
    workers: int = 1,
    provider: str = CPU,
    session: SessionConfig = DEFAULT,
    shard: str | None = None,
    retry_failed: bool = False,
    max_failures: int | None = None,
    overwrite: bool = False,
    on_record: Callable[[dict[str, Any]], None] | None = None,
) -> Summary:
    """Reconstruct the scenes that are missing or changed into `out/<id>/scene.ply`, in a pool of processes.

    scenes: a folder of scene folders, or a .jsonl or .csv with the columns id, images, cameras and options, which go
    before `options`. A scene is done when `out/<id>/record.json`, which is written last, holds the hash of its images,
    cameras, options, model and version. A failed one is recorded, its traceback in `error.txt`, and the rest goes on;
    it is tried again when its inputs change or with `retry_failed`. The run stops after `max_failures` of its own.
    engine: "local". model: as in `reconstruct`. options: keywords of `reconstruct` and fields of `FilterOptions`.
    workers: processes, each with an opened model and its share of the cores unless `session` says how many threads.
    shard: "I/N", the part I of N, from 1. overwrite: replace files in `out` that are no results of a batch.
    on_record: called with the record of each scene that was tried.
    Processes import the main module again: a script must call this under `if __name__ == "__main__":`.
    Raises InputError for invalid arguments, a model that cannot be opened, or a file that would be replaced.
    """
    started = time.perf_counter()
    if engine != LOCAL:
        raise InputError(f"engine {engine!r}: expected {LOCAL!r}")
    if workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more")
    out = Path(out)
    check_local(str(out))
    chosen = choose_shard(read_scenes(Path(scenes)), shard)
    _check_options(options or {})
    candidates(provider)
    _check_apart(Path(scenes), chosen, out)
    if not overwrite:
        _check_own(chosen, out)
    files = read_model(find_model(model))
    threads = session.threads or max(1, usable_cores() // workers)
    settings = Settings(
        *(files, model_sha256(files), provider, replace(session, threads=threads), dict(options or {}), retry_failed)
    )
    summary = Summary(len(chosen))
    failures = 0
    with closing(run_in_pool(chosen, out, min(workers, max(len(chosen), 1)), threads, settings)) as outcomes:
        for outcome in progress(outcomes, "reconstructing scenes", len(chosen), summary.describe_pace):
            summary.add(outcome, time.perf_counter() - started)
            if outcome.tried and on_record is not None:
                on_record(outcome.record)
            failures += outcome.tried and outcome.record["status"] == Status.FAILED
            if max_failures is not None and failures >= max_failures:
                break
    summary.left = summary.scenes - summary.done - summary.failed
    make_folder(out)
    with atomic_write(summary_path(out, shard)) as temporary:
        temporary.write_text(json.dumps(asdict(summary), indent=2) + "\n", encoding="utf-8")
    return summary


def choose_shard(scenes: Sequence[Scene], shard: str | None) -> list[Scene]:
    """Every N-th scene from the I-th on, for a shard "I/N"; raises InputError."""
    if shard is None:
        return list(scenes)
    number, count = parse_shard(shard)
    return list(scenes[number - 1 :: count])


def parse_shard(shard: str) -> tuple[int, int]:
    """The numbers of a shard "I/N"; raises InputError unless I is from 1 to N."""
    parts = shard.split("/")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and len(part) < 10 for part in parts):
        raise InputError(f"--shard {shard[:40]}: expected I/N, such as 1/8")
    number, count = map(int, parts)
    if not 1 <= number <= count:
        raise InputError(f"--shard {shard}: expected a number from 1 to {count}, and how many there are")
    return number, count


def summary_path(out: Path, shard: str | None) -> Path:
    """Where the summary of a run, or of one shard, is written."""
    return out / ("summary-{}-of-{}.json".format(*parse_shard(shard)) if shard else "summary.json")


def _check_options(options: Mapping[str, Any]) -> None:
    unknown = sorted(set(options) - set(OPTIONS))
    if unknown:
        raise InputError(f"unknown option {unknown[0]!r}; expected {', '.join(OPTIONS)}")
    FilterOptions(**{name: options[name] for name in FILTERS if name in options})


def _check_apart(source: Path, scenes: Sequence[Scene], out: Path) -> None:
    """Raise InputError where results would stand among the images."""
    real = os.path.realpath(out)
    folders = [source] if source.is_dir() else [scene.images for scene in scenes]
    for folder in folders:
        if Path(real).is_relative_to(os.path.realpath(folder)):
            raise InputError(f"--out {out}: lies in {folder}, which is an input; choose a folder elsewhere")
    for scene in scenes:
        if Path(os.path.realpath(scene.images)).is_relative_to(os.path.join(real, scene.id)):
            raise InputError(f"--out {out}: the results of {scene.id} would stand beside its images; choose another")


def _check_own(scenes: Sequence[Scene], out: Path) -> None:
    """Raise InputError if a file would be replaced that is no result of a batch."""
    for scene in scenes:
        folder = out / scene.id
        for name in (SPLATS, RECORD):
            if os.path.lexists(folder / name) and read_record(folder) is None:
                raise InputError(
                    f"{folder / name}: exists, and idesplat batch did not write it; choose another --out, or add "
                    "--overwrite to replace it"
                )
