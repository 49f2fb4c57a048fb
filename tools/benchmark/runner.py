"""Running a benchmark: candidates interleaved, round by round, each in a process of its own."""

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ...runtime.errors import InputError
from ...runtime.inference.bundled_model import bundled_model
from ...runtime.inference.session import SessionConfig, usable_cores
from .report import Row
from .worker import Failed, Worker, Workload, analyse, describe, eager, exported, gemm

EAGER = "PyTorch"
# Idle threads of ONNX Runtime and OpenMP keep spinning for a while after a run; the next candidate waits for that.
SETTLE_SECONDS = 0.25
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

OnStatus = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """Settings of all candidates. eager: whether the same networks also run in PyTorch."""

    session: SessionConfig
    repeats: int
    eager: bool

    @property
    def threads(self) -> int:
        """The threads of each candidate."""
        return self.session.threads or usable_cores()


@dataclass(frozen=True)
class ModelCandidate:
    """A model on an execution provider, with the model's metadata."""

    model: Path
    provider: str
    metadata: dict[str, Any]


def settings_for(session: SessionConfig, repeats: int, eager: bool) -> Settings:
    """Settings with a thread for each core by default, and eager PyTorch only where it is installed."""
    session = replace(session, threads=session.threads or usable_cores())
    return Settings(session, repeats, eager and find_spec("torch") is not None)


def benchmark(
    models: Sequence[Path],
    settings: Settings,
    *,
    view_counts: Sequence[int] = (2,),
    sizes: Sequence[tuple[int, int]] = (),
    providers: Sequence[str] = ("CPU",),
    on_status: OnStatus = lambda status: None,
) -> Iterator[list[Row]]:
    """Measure time and memory of models; yields the rows of one workload after another.

    models: .onnx files or staged folders; the bundled model if there are none. sizes: heights and widths; each model's
    own if there are none. on_status: receives what is being done. A candidate that fails keeps its row, with `problem`.
    Raises InputError for a file that is not a model of this project.
    """
    with thread_environment(settings.threads):
        candidates = _model_candidates(models, providers, on_status)
        for workload, group in _workloads(candidates, view_counts, sizes):
            yield measure(group, workload, settings, on_status)


def measure(
    candidates: Sequence[ModelCandidate], workload: Workload, settings: Settings, on_status: OnStatus
) -> list[Row]:
    """A row for each network in eager PyTorch, where that is to be run, and one for each model."""
    rows = [_row(candidate, workload) for candidate in candidates]
    networks = _network_rows(rows, workload, settings)
    _run_interleaved(rows, networks, candidates, workload, settings, on_status)
    for row, candidate in zip(rows, candidates, strict=True):
        if row.problem is None:
            on_status(f"{row.name}: profiling")
            _add_shares(row, candidate, workload, settings)
    for row in (*networks, *rows):
        counted = [other.flop for other in rows if other.preset == row.preset and other.flop]
        row.roofline_flop = min(counted, default=None)
    return [*networks, *rows]


def describe_machine(settings: Settings) -> dict[str, Any]:
    """The machine and the packages' versions, for the JSON."""
    packages = ("idesplat", "numpy", "onnxruntime", *(["torch"] if settings.eager else []))
    return {
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": settings.threads,
        "versions": {package: version(package) for package in packages},
    }


@contextmanager
def thread_environment(threads: int) -> Iterator[None]:
    """Set the number of threads of OpenMP and BLAS for processes started meanwhile."""
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


# ---- candidates


def _model_candidates(models: Sequence[Path], providers: Sequence[str], on_status: OnStatus) -> list[ModelCandidate]:
    """Every model on every provider."""
    candidates = []
    for model in models or [bundled_model()]:
        on_status(f"{model.name}: reading")
        try:
            with Worker(describe, model) as worker:
                candidates += [ModelCandidate(model, provider, worker.about) for provider in providers]
        except Failed as problem:
            raise InputError(str(problem)) from None
    return candidates


def _workloads(
    candidates: Sequence[ModelCandidate], view_counts: Sequence[int], sizes: Sequence[tuple[int, int]]
) -> Iterator[tuple[Workload, list[ModelCandidate]]]:
    """The workloads: all models at each given size, or the models grouped by their own size."""
    groups: dict[tuple[int, int], list[ModelCandidate]] = {size: list(candidates) for size in sizes}
    if not sizes:
        for candidate in candidates:
            groups.setdefault((candidate.metadata["height"], candidate.metadata["width"]), []).append(candidate)
    for size, group in groups.items():
        for count in view_counts:
            yield Workload(count, *size), group


def _row(candidate: ModelCandidate, workload: Workload) -> Row:
    about = candidate.metadata
    names = (candidate.model.name, about["preset"], about.get("precision", "float32"), candidate.provider)
    return Row(*names, **asdict(workload), checkpoint=about["checkpoint_sha256"])


def _network_rows(rows: Sequence[Row], workload: Workload, settings: Settings) -> list[Row]:
    """A row for each of the models' networks, where PyTorch is to run them."""
    if not settings.eager:
        return []
    from ...model.registry import PRESETS  # needs torch

    presets = dict.fromkeys(row.preset for row in rows if row.preset in PRESETS)
    return [Row(f"{EAGER} {preset}", preset, "float32", "CPU", **asdict(workload)) for preset in presets]


# ---- measuring


def _run_interleaved(
    rows: Sequence[Row],
    networks: Sequence[Row],
    candidates: Sequence[ModelCandidate],
    workload: Workload,
    settings: Settings,
    on_status: OnStatus,
) -> None:
    """Run the candidates interleaved, round by round, and record the measurements in the rows."""
    prepared: list[tuple] = [(row, eager, row.preset, settings.threads) for row in networks]
    prepared += [
        (row, exported, candidate.model, candidate.provider, settings.session)
        for row, candidate in zip(rows, candidates, strict=True)
    ]
    with ExitStack() as stack:
        reference = stack.enter_context(Worker(gemm))
        running: list[tuple[Row, Worker]] = []
        for row, *arguments in prepared:
            on_status(f"{row.name}: opening")
            with _noting_failure(row):
                worker = stack.enter_context(Worker(*arguments, workload))
                row.provider = worker.about.get("provider", row.provider)
                running.append((row, worker))
        for turn in range(settings.repeats):
            first = turn % max(len(running), 1)  # no candidate always runs after the same one
            for row, worker in running[first:] + running[:first]:
                on_status(f"{row.name}: round {turn + 1} of {settings.repeats}")
                _run_once(row, worker, reference)
        _note_depth_errors(running)
        for row, worker in running:
            with _noting_failure(row):
                row.load_seconds = worker.about["load_seconds"]
                row.peak_bytes = worker.finish() if row.problem is None else None
    seconds = {row.preset: row.seconds for row in networks}
    for row in rows:
        row.eager_seconds = seconds.get(row.preset, []) if row.seconds else []


def _run_once(row: Row, worker: Worker, reference: Worker) -> None:
    """Run a candidate once more, after the GEMM reference; skipped where the candidate has failed."""
    if row.problem is None:
        with _noting_failure(row):
            row.gemm_rates.append(reference.run().result)
            time.sleep(SETTLE_SECONDS)
            row.seconds.append(worker.run().seconds)
            time.sleep(SETTLE_SECONDS)


@contextmanager
def _noting_failure(row: Row) -> Iterator[None]:
    """Remove a failing candidate from the benchmark; its row keeps the reason."""
    try:
        yield
    except Failed as problem:
        row.problem, row.seconds, row.gemm_rates = str(problem), [], []


def _note_depth_errors(running: Sequence[tuple[Row, Worker]]) -> None:
    """Record how much each model's depth differs from that of the first one of the same checkpoint."""
    first: dict[str, np.ndarray] = {}
    for row, worker in running:
        if row.checkpoint:
            depth = worker.about["depth"]
            reference = first.setdefault(row.checkpoint, depth)
            if depth is not reference:
                row.depth_error = float(np.median(np.abs(depth - reference) / reference))


def _add_shares(row: Row, candidate: ModelCandidate, workload: Workload, settings: Settings) -> None:
    """Profile a model: the shares of its time by operator and stage, and its FLOP."""
    try:
        with Worker(analyse, candidate.model, row.provider, settings.session, workload) as worker:
            row.operators, row.stages, row.flop = (worker.about[part] for part in ("operators", "stages", "flop"))
    except Failed as problem:
        row.problem = f"could not be profiled ({problem})"
