"""Benchmark of training: scenes per second of configurations, interleaved, and the shares of a step's time."""

import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ...runtime.errors import InputError
from ...runtime.system.files import scratch_folder

if TYPE_CHECKING:
    from ..training.parallel import ProcessGroup
    from ..training.trainer import Trainer

# Length of the run whose phases are measured.
STEPS = 1000
# Steps before the measurement, in which code is compiled and textures are generated.
WARM_UP = 1
SIZE = 256


@dataclass(frozen=True)
class Candidate:
    """A configuration of training. together: scenes of two views that the network takes at once."""

    preset: str
    precision: str
    processes: int
    batch: int
    together: int

    @property
    def name(self) -> str:
        """As the table shows it."""
        scenes = f"{self.batch} scene(s), {self.together} at once"
        return f"{self.preset}, {self.precision}, {self.processes} process(es), {scenes}"


# The first configuration that was trained, and present ones: full steps on one scene at a time, or on several at once.
CANDIDATES = (
    Candidate("idesplat-tiny", "float32", 1, 1, 1),
    Candidate("idesplat-lite", "bf16", 2, 4, 1),
    Candidate("idesplat-lite", "bf16", 2, 16, 4),
)
# Step of the run at which a phase begins, by what it trains.
PHASES = {"128x128, first DPBU": 0, "256x256, everything": 900}


# By phase and candidate: the rounds' seconds, CPU seconds, scenes, and seconds by part of a step.
Measured = dict[tuple[str, Candidate], list[dict[str, Any]]]


def benchmark_training(rounds: int, steps: int, on_status: Callable[[str], None] = lambda status: None) -> Measured:
    """Measure every candidate in every phase, interleaved, each in new processes.

    steps: of each measurement. on_status: receives what is being done. Raises InputError if a process fails.
    """
    found: Measured = defaultdict(list)
    for turn in range(rounds):
        for phase in PHASES:
            for candidate in CANDIDATES:
                on_status(f"round {turn + 1} of {rounds}: {phase}, {candidate.name}")
                found[phase, candidate].append(_measure(phase, candidate, steps))
    return found


def print_training(found: Measured) -> None:
    """Print the best round of every candidate in every phase."""
    table = Table("phase", "training", "scenes/s", "CPU s/scene", "where the time goes", title="best of the rounds")
    for (phase, candidate), measured in found.items():
        best = min(measured, key=lambda one: one["seconds"])
        parts = ", ".join(f"{name} {share:.0%}" for name, share in best["parts"].items() if share >= 0.01)
        rate, cpu = best["scenes"] / best["seconds"], min(one["cpu"] / one["scenes"] for one in measured)
        table.add_row(phase, candidate.name, f"{rate:.2f}", f"{cpu:.2f}", parts)
    Console().print(table)


def _measure(phase: str, candidate: Candidate, steps: int) -> dict[str, Any]:
    """Measure one candidate in a process of its own, which starts others; raises InputError if that fails."""
    command = [sys.executable, "-P", "-m", __name__, phase, json.dumps(list(vars(candidate).values())), str(steps)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["without a message; memory may have run out"])[-1]
        raise InputError(f"{candidate.name}: its process ended with {done.returncode} ({reason})")
    return json.loads(done.stdout.splitlines()[-1])


def _worker(phase: str, candidate: Candidate, steps: int) -> None:
    """The main process of a measurement; prints seconds, CPU seconds of all processes, scenes and shares as JSON."""
    from ..training.parallel import ProcessGroup, spawn_workers

    with scratch_folder() as folder:
        run = _run_at(folder, phase, candidate, ProcessGroup(0, candidate.processes))
        with spawn_workers(candidate.processes, _other, folder, phase, candidate, steps):
            print(json.dumps(_timed_steps(run, steps)))


def _other(group: "ProcessGroup", folder: Path, phase: str, candidate: Candidate, steps: int) -> None:
    _timed_steps(_run_at(folder, phase, candidate, group), steps)


def _run_at(folder: Path, phase: str, candidate: Candidate, group: "ProcessGroup") -> "Trainer":
    """A new trainer at the beginning of a phase."""
    from ..training.options import Resources
    from ..training.settings import TrainingSettings, network_config
    from ..training.trainer import Trainer

    resources = Resources(candidate.processes, together=candidate.together)
    settings = TrainingSettings(
        *(candidate.preset, "both", True, STEPS, candidate.batch, SIZE, 1e-3, 5e-4, 0, "", []),
        precision=candidate.precision,
    )
    run = Trainer(folder, settings, network_config(settings), group=group, resources=resources)
    run.state.step = PHASES[phase]
    return run


def _timed_steps(run: "Trainer", steps: int) -> dict[str, Any]:
    """Make some steps after the warm-up; CPU seconds are summed over the processes."""
    from ..training.data.samples import prefetch

    with closing(prefetch(run.specs(), run.task.load)) as scenes:
        for _ in range(WARM_UP):
            run.train_step(scenes)
        parts = _timed_parts(run)
        started, cpu = time.perf_counter(), time.process_time()
        for _ in range(steps):
            run.train_step(_timed(scenes, parts))
        seconds, cpu = time.perf_counter() - started, time.process_time() - cpu
    total_cpu = sum(entry["cpu"] for entry in run.group.gather([{"cpu": cpu}]))
    parts["rendering and losses"] -= sum(parts[name] for name, _ in run.state.model.named_children())
    parts["backward"] = seconds - sum(parts.values())
    shares = {name: part / seconds for name, part in sorted(parts.items(), key=lambda item: -item[1])}
    return {"seconds": seconds, "cpu": total_cpu, "scenes": steps * run.settings.batch, "parts": shares}


def _timed_parts(run: "Trainer") -> dict[str, float]:
    """Seconds by part of a step, updated from now on: the network's stages, losses, all-reduce and optimiser."""
    parts: dict[str, float] = defaultdict(float)

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any) -> Any:
            started = time.perf_counter()
            result = call(*arguments)
            parts[name] += time.perf_counter() - started
            return result

        return wrapped

    for name, stage in run.state.model.named_children():
        stage.forward = timed(name, stage.forward)
    changed: Any = run  # methods of these objects are replaced
    changed.task.loss = timed("rendering and losses", run.task.loss)
    changed.group.all_reduce_gradients = timed("waiting and exchange", run.group.all_reduce_gradients)
    changed.state.update = timed("optimiser", run.state.update)
    return parts


def _timed(scenes: Iterator[Any], parts: dict[str, float]) -> Iterator[Any]:
    """The same scenes; the time spent waiting for them counts as a part."""
    while True:
        started = time.perf_counter()
        scene = next(scenes)
        parts["waiting for scenes"] += time.perf_counter() - started
        yield scene


if __name__ == "__main__":
    _worker(sys.argv[1], Candidate(*json.loads(sys.argv[2])), int(sys.argv[3]))
