"""Candidates of a benchmark, each in a fresh process: its peak memory is its own, and it waits while others run."""

import json
import multiprocessing
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import prod
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...runtime.errors import one_line
from ...runtime.system.memory import peak_bytes
from ..processes import safe_path

if TYPE_CHECKING:
    from ...runtime.inference.session import SessionConfig

# Side of the GEMM reference's square matrices, large enough to reach the machine's peak rate.
GEMM_SIDE = 2048
GEMM_FLOP = 2 * GEMM_SIDE**3
GEMM_REPEATS = 3
TIMES_PROFILED = 2
NODE_SUFFIX = "_kernel_time"
# Operators whose time includes that of their subgraphs' operators.
LOOPS = ("Scan", "Loop", "If")
# Operators whose FLOP are counted, in the graph before optimisation.
MATMULS = ("MatMul", "MatMulInteger", "Gemm", "Conv", "ConvTranspose")
RUN = "run"


@dataclass(frozen=True)
class Workload:
    """Number and size of the views."""

    views: int
    height: int
    width: int


class Run(NamedTuple):
    """One run of a candidate: its seconds, and its result."""

    seconds: float
    result: Any


class Failed(Exception):
    """Raised if a candidate cannot run; the message has the reason."""


Prepared = tuple[Any, Callable[[], Any]]


class Worker:
    """Handle of a candidate's process."""

    def __init__(self, prepare: Callable[..., Prepared], *arguments: Any) -> None:
        """Call `prepare` in a new process; `about` holds the first of its results, the second is run. Raises Failed."""
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, prepare, arguments), daemon=True)
        with safe_path():
            self._process.start()
        other.close()
        self.about = self._answer()

    def run(self) -> Run:
        """Run it once. Raises Failed."""
        self._pipe.send(RUN)
        return self._answer()

    def finish(self) -> int | None:
        """End the process; returns its peak memory in bytes, None if it is unknown. Raises Failed."""
        self._pipe.send(None)
        peak = self._answer()
        self._process.join()
        return peak

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process if it still runs."""
        self._process.kill()
        self._process.join()

    def _answer(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            raise Failed(f"its process ended with {self._process.exitcode}; memory may have run out") from None
        if isinstance(answer, Failed):
            raise answer
        return answer


def _serve(pipe: Connection, prepare: Callable[..., Prepared], arguments: tuple) -> None:
    """The candidate's process: runs on request."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the measuring process decides when to stop
    try:
        about, run = prepare(*arguments)
        pipe.send(about)
        while pipe.recv() == RUN:
            started = time.perf_counter()
            result = run()
            pipe.send(Run(time.perf_counter() - started, result))
        pipe.send(peak_bytes())
    except EOFError:  # the measuring process is gone
        pass
    except Exception as error:
        pipe.send(Failed(one_line(error)))


# ---- candidates: what `about` holds, and what is run


def gemm() -> Prepared:
    """The GEMM reference: the product of two large matrices in NumPy; a run gives FLOP per second.

    The number of NumPy's threads comes from the environment.
    """
    left, right = np.random.default_rng(0).random((2, GEMM_SIDE, GEMM_SIDE), np.float32)

    def run() -> float:
        started = time.perf_counter()
        for _ in range(GEMM_REPEATS):
            np.matmul(left, right)
        return GEMM_REPEATS * GEMM_FLOP / (time.perf_counter() - started)

    run()
    return None, run


def describe(model: Path) -> Prepared:
    """A model's metadata."""
    from ...runtime.inference.model_files import read_model

    return asdict(read_model(model).metadata), dict


def exported(model: Path, provider: str, config: "SessionConfig", workload: Workload) -> Prepared:
    """An exported model; `about` holds the provider, the seconds to open it, and its predicted depth."""
    from ...runtime.inference.predictor import Predictor

    started = time.perf_counter()
    predictor = Predictor(model, provider, config)
    load_seconds = time.perf_counter() - started
    arrays = example_arrays(workload, predictor.metadata.near, predictor.metadata.far)

    def run() -> None:
        predictor.predict_arrays(*arrays)

    depth = predictor.predict_arrays(*arrays).depth
    return {"provider": predictor.provider.name, "load_seconds": load_seconds, "depth": depth}, run


def eager(preset: str, threads: int, workload: Workload) -> Prepared:
    """A preset's network in eager PyTorch with initial weights; its time does not depend on them."""
    import torch

    from ...model.registry import build

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    started = time.perf_counter()
    network = build(preset).eval()
    config = network.config
    tensors = [torch.from_numpy(array) for array in example_arrays(workload, config.near, config.far)]

    def run() -> None:
        with torch.inference_mode():
            network(*tensors)

    about = {"load_seconds": time.perf_counter() - started}
    run()
    return about, run


def analyse(model: Path, provider: str, config: "SessionConfig", workload: Workload) -> Prepared:
    """Profile a model; `about` holds the result, and there is nothing to run.

    operators, stages: shares of the time, by name. flop: of its matmuls and convolutions.
    """
    from ...runtime.inference.providers import CPU

    kernels = _profile(model, provider, config, workload, optimise=True)
    operators: Counter[str] = Counter()
    stages: Counter[str] = Counter()
    for kernel in kernels:
        if kernel["args"]["op_name"] in LOOPS:
            continue
        operators[kernel["args"]["op_name"]] += kernel["dur"]
        scope = kernel["name"].split("/")
        stages[scope[1] if len(scope) > 2 else "other"] += kernel["dur"]
    plain = _profile(model, CPU, replace(config, device=None, provider_options={}), workload, optimise=False)
    flop = sum(flop_of(kernel["args"]) for kernel in plain)
    return {"operators": _shares(operators), "stages": _shares(stages), "flop": flop}, dict


def example_arrays(workload: Workload, near: float, far: float) -> tuple[np.ndarray, ...]:
    """A model's inputs in their order: images of coarse noise, and cameras on a line."""
    views, height, width = workload.views, workload.height, workload.width
    rng = np.random.default_rng(0)
    coarse = rng.random((views, 3, height // 8 + 1, width // 8 + 1), np.float32)
    images = np.repeat(np.repeat(coarse, 8, axis=2), 8, axis=3)[:, :, :height, :width]
    extrinsics = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
    extrinsics[:, 0, 3] = near * np.linspace(-0.4, 0.4, views)
    K = np.array([[0.9, 0, 0.5], [0, 0.9, 0.5], [0, 0, 1]], np.float32)
    ranges = np.full(views, near, np.float32), np.full(views, far, np.float32)
    return np.ascontiguousarray(images), extrinsics, np.tile(K, (views, 1, 1)), *ranges


def _profile(
    model: Path, provider: str, config: "SessionConfig", workload: Workload, optimise: bool
) -> list[dict[str, Any]]:
    """ONNX Runtime's profile of every operator of a run; of an optimised graph, of its second run."""
    from ...runtime.inference.predictor import Predictor
    from ...runtime.system.files import scratch_folder

    with scratch_folder() as folder:
        predictor = Predictor(model, provider, replace(config, profile=folder / "profile", optimise=optimise))
        arrays = example_arrays(workload, predictor.metadata.near, predictor.metadata.far)
        for _ in range(TIMES_PROFILED if optimise else 1):
            predictor.predict_arrays(*arrays)
        return [kernel for path in predictor.end_profiling() for kernel in last_kernels(path)]


def last_kernels(profile: Path) -> list[dict[str, Any]]:
    """The operators of the last run in a profile that ONNX Runtime wrote."""
    events = json.loads(profile.read_text())
    last = max(event["ts"] for event in events if event["name"] == "model_run")
    return [event for event in events if event["name"].endswith(NODE_SUFFIX) and event["ts"] >= last]


def flop_of(args: dict[str, Any]) -> int:
    """Floating-point operations of one operator, from the shapes in ONNX Runtime's profile."""
    operator = args["op_name"]
    if operator not in MATMULS:
        return 0
    first, second = (next(iter(entry.values())) for entry in args["input_type_shape"][:2])
    result = next(iter(args["output_type_shape"][0].values()))
    if operator == "Conv":
        return 2 * prod(result) * prod(second[1:])
    if operator == "ConvTranspose":
        return 2 * prod(first) * prod(second[1:])
    terms = prod(first) // result[0] if operator == "Gemm" else first[-1]
    return 2 * prod(result) * terms


def _shares(times: Counter[str]) -> dict[str, float]:
    """Each name's share of the total, largest first."""
    whole = sum(times.values()) or 1
    return {name: time / whole for name, time in times.most_common()}
