"""The command idesplat-bench: how long exported models take, how much memory, and on what.

Candidates run interleaved, round by round, each in a process of its own, so transient load affects all of them equally.
Beside them run a large GEMM, whose rate is the roofline, and the same networks in eager PyTorch where it is installed.
"""

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...runtime.cli.input_files import model_files
from ...runtime.cli.outputs import STANDARD_OUTPUT, Overwrite, guards_outputs, outputs
from ...runtime.cli.terminal import literal, run, say, warn
from ...runtime.errors import InputError, exit_on_input_error
from ...runtime.images.sizes import parse_size
from ...runtime.system.limits import parse_whole_number

if TYPE_CHECKING:  # nothing heavy is loaded before there is something to measure
    from .report import Row
    from .worker import Worker, Workload

WORSE = 1  # exit status where --compare finds something that became worse
INTERRUPTED = 130
FEWEST_VIEWS = 2
STEPS_OF_A_ROUND = 3  # of training
EAGER = "PyTorch"
# Threads that have done their work keep spinning for a while; nobody should run beside them.
SETTLE_SECONDS = 0.25
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

Say = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """How everything is run."""

    threads: int
    repeats: int
    eager: bool


@dataclass(frozen=True)
class Entry:
    """A model on a provider, and what the model's file says of itself."""

    model: Path
    provider: str
    metadata: dict[str, Any]


@exit_on_input_error
@guards_outputs("idesplat-bench")
def bench(
    models: Annotated[
        list[Path] | None, typer.Argument(help="Models (.onnx or staged folders) instead of the bundled one.")
    ] = None,
    views: Annotated[str, typer.Option(help="Numbers of views, such as 2,4.")] = "2",
    sizes: Annotated[
        str | None, typer.Option(help="Sizes, such as 256x256,256x448, instead of each model's own.")
    ] = None,
    providers: Annotated[str, typer.Option(help="Execution providers, such as CPU,CUDA.")] = "CPU",
    repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 7,
    threads: Annotated[int | None, typer.Option(help="Threads of each, instead of one a core.", min=1)] = None,
    eager: Annotated[bool, typer.Option(help="Run the same networks in PyTorch, where it is installed.")] = True,
    training: Annotated[
        bool, typer.Option("--training", help="Measure training instead: scenes a second, as it was and as it is.")
    ] = False,
    json_path: Annotated[
        Path | None, typer.Option("--json", help="Write everything as JSON, to standard output if it is -.")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(help="Such a JSON; exit with status 1 if anything became worse since.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure time and memory of exported models side by side, each in a fresh process. Ctrl-C keeps what is done."""
    if training:
        from .training import bench_training

        bench_training(repeats, STEPS_OF_A_ROUND)
        return
    from .report import compare as compare_rows
    from .report import print_rows, read_rows, write_rows

    _check_json(json_path, [*(models or []), *([compare] if compare else [])])
    before = read_rows(compare) if compare is not None else []
    settings = _settings(threads, repeats, eager)
    rows: list[Row] = []
    interrupted = False
    try:
        for measured in _measure_all(models or [], providers.split(","), _counts(views), _shapes(sizes), settings):
            rows += measured
    except KeyboardInterrupt:
        interrupted = True
    for row in rows:
        if row.problem:
            warn(f"{row.name}: {row.problem}")
    rows = [row for row in rows if row.seconds]
    if rows:
        print_rows(rows)
    if rows and json_path is not None:
        write_rows(json_path, _machine(settings), rows)
        if json_path != STANDARD_OUTPUT:
            say(f"wrote {json_path}")
    if interrupted:
        warn("interrupted: what was not finished is missing")
        raise SystemExit(INTERRUPTED)
    if not rows:
        raise InputError("nothing could be measured, for the reasons above")
    worse = compare_rows(rows, before) if compare is not None else []
    for line in worse:
        warn(f"worse: {line}")
    if worse:
        raise SystemExit(WORSE)


def main() -> None:
    """Run the command."""
    run(bench)


def _check_json(json_path: Path | None, read: Sequence[Path]) -> None:
    """Find out before the work whether the JSON can be written, and is none of the files to read."""
    if json_path is None or json_path == STANDARD_OUTPUT:
        return
    for path in read:
        outputs().reads("a model or measurements", model_files(path))
    outputs().writes("--json", [json_path])


# ---- measuring


def _measure_all(
    models: Sequence[Path],
    providers: Sequence[str],
    counts: Sequence[int],
    shapes: Sequence[tuple[int, int]],
    settings: Settings,
) -> "Iterator[list[Row]]":
    """The rows of one workload after another."""
    with thread_environment(settings.threads), _saying() as say:
        entries = _entries(models, providers, say)
        for workload, group in _workloads(entries, counts, shapes):
            yield measure(group, workload, settings, say)


def measure(entries: Sequence[Entry], workload: "Workload", settings: Settings, say: Say) -> "list[Row]":
    """A row for each network in PyTorch, where that is to be run, and one for each model."""
    rows = [_row(entry, workload) for entry in entries]
    networks = _network_rows(rows, workload, settings)
    _run_interleaved(rows, networks, entries, workload, settings, say)
    for row, entry in zip(rows, entries, strict=True):
        if row.problem is None:
            say(f"{row.name}: where its time goes")
            _add_shares(row, entry, workload, settings)
    for row in (*networks, *rows):
        counted = [other.flop for other in rows if other.preset == row.preset and other.flop]
        row.roofline_flop = min(counted, default=None)
    return [*networks, *rows]


def _run_interleaved(
    rows: "Sequence[Row]",
    networks: "Sequence[Row]",
    entries: Sequence[Entry],
    workload: "Workload",
    settings: Settings,
    say: Say,
) -> None:
    """Run the candidates interleaved, round by round, and record the measurements in the rows."""
    from .worker import Worker, eager, exported, gemm

    prepared: list[tuple] = [(row, eager, row.preset) for row in networks]
    prepared += [(row, exported, entry.model, entry.provider) for row, entry in zip(rows, entries, strict=True)]
    with ExitStack() as stack:
        reference = stack.enter_context(Worker(gemm))
        running: list[tuple[Row, Worker]] = []
        for row, *candidate in prepared:
            say(f"{row.name}: opening")
            with _noting_failure(row):
                worker = stack.enter_context(Worker(*candidate, settings.threads, workload))
                running.append((row, worker))
        for turn in range(settings.repeats):
            first = turn % max(len(running), 1)  # no candidate always runs after the same one
            for row, worker in running[first:] + running[:first]:
                say(f"{row.name}: round {turn + 1} of {settings.repeats}")
                _run_once(row, worker, reference)
        _note_depth_errors(running)
        for row, worker in running:
            with _noting_failure(row):
                row.load_seconds = worker.about["load_seconds"]
                row.peak_bytes = worker.finish() if row.problem is None else None
    seconds = {row.preset: row.seconds for row in networks}
    for row in rows:
        row.eager_seconds = seconds.get(row.preset, []) if row.seconds else []


def _run_once(row: "Row", worker: "Worker", reference: "Worker") -> None:
    """Run a candidate once more, after the GEMM reference; skipped where the candidate has failed."""
    if row.problem is None:
        with _noting_failure(row):
            row.gemm_rates.append(reference.run().result)
            time.sleep(SETTLE_SECONDS)
            row.seconds.append(worker.run().seconds)
            time.sleep(SETTLE_SECONDS)


@contextmanager
def _noting_failure(row: "Row") -> Iterator[None]:
    """Take a candidate that fails out of the benchmark; its row says why."""
    from .worker import Failed

    try:
        yield
    except Failed as problem:
        row.problem, row.seconds, row.gemm_rates = str(problem), [], []


def _note_depth_errors(running: "Sequence[tuple[Row, Worker]]") -> None:
    """How far each model's depth is from that of the first one of the same checkpoint."""
    import numpy as np

    first: dict[str, np.ndarray] = {}
    for row, worker in running:
        if row.checkpoint:
            depth = worker.about["depth"]
            reference = first.setdefault(row.checkpoint, depth)
            if depth is not reference:
                row.depth_error = float(np.median(np.abs(depth - reference) / reference))


def _add_shares(row: "Row", entry: Entry, workload: "Workload", settings: Settings) -> None:
    """Where the time of a model goes, and how much it computes."""
    from .worker import Failed, Worker, analyse

    try:
        with Worker(analyse, entry.model, entry.provider, settings.threads, workload) as worker:
            row.operators, row.stages, row.flop = (worker.about[part] for part in ("operators", "stages", "flop"))
    except Failed as problem:
        warn(f"{row.name}: nothing is known of where its time goes ({problem})")


# ---- what is measured


def _settings(threads: int | None, repeats: int, eager: bool) -> Settings:
    from ...runtime.inference.session import usable_cores

    return Settings(threads or usable_cores(), repeats, eager and find_spec("torch") is not None)


def _counts(text: str) -> list[int]:
    """The option --views, `2,4`, as numbers; raises InputError."""
    parts = text.split(",")
    if not all((parse_whole_number(part) or 0) >= FEWEST_VIEWS for part in parts):
        raise InputError(f"--views {text}: expected numbers from {FEWEST_VIEWS}, such as 2,4")
    return [int(part) for part in parts]


def _shapes(text: str | None) -> list[tuple[int, int]]:
    """The option --sizes, `256x256,256x448`, as heights and widths, none where it is not given; raises InputError."""
    return [parse_size(size) for size in text.split(",")] if text is not None else []


def _entries(models: Sequence[Path], providers: Sequence[str], say: Say) -> list[Entry]:
    """Every model on every provider; raises InputError for a file that is not a model of this project."""
    from ...runtime.inference.bundled_model import bundled_model
    from .worker import Failed, Worker, describe

    entries = []
    for model in models or [bundled_model()]:
        say(f"{model.name}: reading")
        try:
            with Worker(describe, model) as worker:
                entries += [Entry(model, provider, worker.about) for provider in providers]
        except Failed as problem:
            raise InputError(str(problem)) from None
    return entries


def _workloads(
    entries: Sequence[Entry], counts: Sequence[int], shapes: Sequence[tuple[int, int]]
) -> "Iterator[tuple[Workload, list[Entry]]]":
    """What runs side by side: all models at each size that was asked for, or else those whose own size is the same."""
    from .worker import Workload

    groups: dict[tuple[int, int], list[Entry]] = {shape: list(entries) for shape in shapes}
    if not shapes:
        for entry in entries:
            groups.setdefault((entry.metadata["height"], entry.metadata["width"]), []).append(entry)
    for shape, group in groups.items():
        for count in counts:
            yield Workload(count, *shape), group


def _row(entry: Entry, workload: "Workload") -> "Row":
    from .report import Row

    about = entry.metadata
    names = (entry.model.name, about["preset"], about.get("precision", "float32"), entry.provider)
    return Row(*names, **asdict(workload), checkpoint=about["checkpoint_sha256"])


def _network_rows(rows: "Sequence[Row]", workload: "Workload", settings: Settings) -> "list[Row]":
    """A row for each of the models' networks, where PyTorch is to run them."""
    from ...model.registry import PRESETS
    from .report import Row

    presets = dict.fromkeys(row.preset for row in rows if row.preset in PRESETS)
    return [
        Row(f"{EAGER} {preset}", preset, "float32", "CPU", **asdict(workload)) for preset in presets if settings.eager
    ]


# ---- around it


@contextmanager
def thread_environment(threads: int) -> Iterator[None]:
    """Tell the libraries of the processes that start meanwhile how many threads to take."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _saying() -> Iterator[Say]:
    """What is being done, on stderr where that is a terminal."""
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield lambda doing: status.update(literal(doing))


def _machine(settings: Settings) -> dict[str, Any]:
    """Where it was measured."""
    packages = ("idesplat", "numpy", "onnxruntime", *(["torch"] if settings.eager else []))
    return {
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": settings.threads,
        "versions": {package: version(package) for package in packages},
    }


if __name__ == "__main__":
    main()
