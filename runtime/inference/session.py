"""ONNX Runtime sessions: provider checks, thread and memory settings, runs with a time limit."""

import logging
import os
import re
import threading
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime

from ..errors import InputError
from ..system.files import check_regular
from . import openvino
from .graph_cache import cache_entry

LOG = logging.getLogger(__name__)

CPU = "CPUExecutionProvider"
# Errors reach the caller as exceptions; ONNX Runtime's own log would print them to the terminal a second time.
FATAL_ONLY = 4
AS_MANY_AS_CORES = 0  # threads
SUFFIX = "ExecutionProvider"
# Time limit of a run, so that a graph with an endless loop is stopped: several times what the slowest network takes on
# one core of a slow machine.
RUN_LIMIT_S = 900.0
RUN_LIMIT_S_PER_PIXEL = 2e-3  # of all views together
LIMIT_VARIABLE = "IDESPLAT_RUN_LIMIT"  # environment variable: seconds, instead of both
MAX_REASON = 300  # characters of ONNX Runtime's messages that are quoted
# The prefix of its messages: source file, line and function.
SOURCE = re.compile(r"^\S+\.(?:cc|h):\d+ .*?\) ")
OUT_OF_MEMORY = ("Failed to allocate memory", "bad_alloc", "bad allocation", "out of memory")

onnxruntime.set_default_logger_severity(FATAL_ONLY)


def provider_name(provider: str) -> str:
    """The full name of a provider given as `cuda`, `CUDA` or `CUDAExecutionProvider`.

    Raises InputError naming what is installed.
    """
    wanted = provider.removesuffix(SUFFIX).lower()
    if wanted == openvino.PROVIDER.removesuffix(SUFFIX).lower():
        if not openvino.installed():
            raise InputError("execution provider OpenVINO is not installed; pip install 'idesplat[openvino]'")
        return openvino.PROVIDER
    available = onnxruntime.get_available_providers()
    for name in available:
        if name.removesuffix(SUFFIX).lower() == wanted:
            return name
    offered = ", ".join(name.removesuffix(SUFFIX) for name in available)
    raise InputError(f"execution provider {provider} is not installed; this ONNX Runtime offers {offered}")


@dataclass(frozen=True)
class SessionConfig:
    """How sessions are opened. The defaults are right but for benchmarks and profiling."""

    # None for all cores that the process may use.
    threads: int | None = None
    # Prefix of the file to which ONNX Runtime writes the time and the shapes of every operator; None for no profile.
    profile: Path | None = None
    # Whether ONNX Runtime optimises the graph.
    optimise: bool = True


DEFAULT = SessionConfig()


def open_session(
    model: Path | bytes, provider: str = CPU, config: SessionConfig = DEFAULT
) -> onnxruntime.InferenceSession:
    """Load a graph, from a file or its bytes, on one execution provider, given by its full name (`provider_name`).

    On the CPU a file's optimised graph is cached (`graph_cache`).
    Raises InputError if the file cannot be loaded, if ONNX Runtime silently fell back to another provider, or if
    OpenVINO supports no CPU of this machine.
    """
    if isinstance(model, Path):
        with suppress(OSError):  # ONNX Runtime says that there is no such file
            check_regular(model)
    options = _options(config)
    LOG.debug("opening %s on %s with %s", "a graph in memory" if isinstance(model, bytes) else model, provider, config)
    if provider == openvino.PROVIDER:
        openvino.add_openvino(options)
    if provider == CPU and isinstance(model, Path) and config.optimise:
        cached = _open_cached(model, options)
        if cached is not None:
            return cached
    try:
        session = _create(model, options, provider)
    except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
        where = "the model" if isinstance(model, bytes) else model
        raise InputError(
            f"{where}: ONNX Runtime cannot load it ({_reason(error)}); is it an .onnx file of this project?"
        ) from None
    if session.get_providers()[0] != provider:
        raise InputError(
            f"{provider} was asked for, but ONNX Runtime fell back to {session.get_providers()[0]}; "
            "its libraries are missing or do not fit, or choose another --provider"
        )
    return session


def usable_cores() -> int:
    """The number of CPU cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _options(config: SessionConfig) -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = FATAL_ONLY
    # The planning of reuse is quadratic in the number of nodes. Without it a session opens ten times faster, and a run
    # takes neither more time nor more memory, because the arena reuses buffers anyway.
    options.enable_mem_reuse = False
    # The memory pattern would allocate one block for later runs beside the first run's memory: half as much again, for
    # no gain in time.
    options.enable_mem_pattern = False
    # By default ONNX Runtime 1.31 pins a thread to every core, also to those outside the process's affinity mask.
    restricted = usable_cores() < (os.cpu_count() or 1)
    options.intra_op_num_threads = config.threads or (usable_cores() if restricted else AS_MANY_AS_CORES)
    if config.profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(config.profile)
    if not config.optimise:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.add_session_config_entry(
            "session.disable_prepacking", "1"
        )  # else a profile lacks the shapes of weights
    return options


def _create(
    model: Path | bytes, options: onnxruntime.SessionOptions, provider: str = CPU
) -> onnxruntime.InferenceSession:
    source = model if isinstance(model, bytes) else str(model)
    providers = None if provider == openvino.PROVIDER else [provider]  # a plug-in is given in the options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a provider that is not there, which `open_session` raises for
        return onnxruntime.InferenceSession(source, options, providers=providers)


def _open_cached(model: Path, options: onnxruntime.SessionOptions) -> onnxruntime.InferenceSession | None:
    """A session of the cached optimised graph, which is added to the cache if missing; None where that fails."""
    entry = cache_entry(model)
    if entry is None:
        return None

    def optimise(target: Path) -> onnxruntime.InferenceSession:
        options.optimized_model_filepath = str(target)
        return _create(model, options)

    found = entry.get()
    LOG.info("%s: %s", model, f"its optimised graph is cached as {found}" if found else "optimising its graph, once")
    try:
        if found is None:
            return entry.put(optimise)
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        return _create(found, options)
    except Exception:  # a damaged model or a full disk: opening the model itself raises the error, if it is the model's
        LOG.info("%s: the cache cannot be used", model, exc_info=LOG.isEnabledFor(logging.DEBUG))
        if found is not None:
            entry.evict(found)
        return None
    finally:
        options.optimized_model_filepath = ""
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL


def run_session(
    session: onnxruntime.InferenceSession,
    feeds: dict[str, np.ndarray],
    outputs: Sequence[str] | None = None,
    limit_s: float | None = None,
) -> dict[str, np.ndarray]:
    """Run a graph and return its outputs, or those named, by name. Feeds that are not its inputs are ignored.

    limit_s: seconds after which the run is stopped; None for no limit. It is stopped between two operators: an operator
    that does not end cannot be.
    Raises InputError if an input is missing, the graph cannot run on these feeds, or it exceeds the limit.
    """
    missing = [entry.name for entry in session.get_inputs() if entry.name not in feeds]
    if missing:
        raise InputError(f"the graph needs the input {missing[0]}, which is not given; export the model again")
    wanted = {entry.name: feeds[entry.name] for entry in session.get_inputs()}
    names = [entry.name for entry in session.get_outputs()] if outputs is None else list(outputs)
    options = onnxruntime.RunOptions()
    options.log_severity_level = FATAL_ONLY
    ended = threading.Event()
    watchdog = _watchdog(options, ended, limit_s)
    try:
        found = session.run(names, wanted, options)
    except Exception as error:  # of many kinds, as above; also out of memory
        if ended.is_set():
            late = f"the graph did not end within {limit_s:g} s and was stopped"
            raise InputError(f"{late}; allow more by the environment variable {LIMIT_VARIABLE}=SECONDS") from None
        raise InputError(f"ONNX Runtime cannot run the graph ({_reason(error)}){_remedy(error)}") from None
    finally:
        if watchdog is not None:
            watchdog.cancel()
    return dict(zip(names, found, strict=True))


def run_limit_s(pixels: int) -> float:
    """The time limit in seconds for so many pixels of all views; raises InputError for an invalid LIMIT_VARIABLE."""
    given = os.environ.get(LIMIT_VARIABLE)
    if given is None:
        return RUN_LIMIT_S + RUN_LIMIT_S_PER_PIXEL * pixels
    try:
        limit = float(given)
    except ValueError:
        limit = 0.0
    if not 0 < limit <= threading.TIMEOUT_MAX:
        raise InputError(f"{LIMIT_VARIABLE} is {given}: expected the seconds that a model may run, such as 3600")
    return limit


def _watchdog(options: onnxruntime.RunOptions, ended: threading.Event, limit_s: float | None) -> threading.Timer | None:
    """A timer that stops the run with these options after the limit; None for no limit."""
    if limit_s is None:
        return None

    def end() -> None:
        ended.set()
        options.terminate = True

    timer = threading.Timer(limit_s, end)
    timer.daemon = True  # an interrupted command does not wait for it
    timer.start()
    return timer


def _reason(error: Exception) -> str:
    """ONNX Runtime's message in one line, without status codes and source locations."""
    text = " ".join(str(error).split())
    _, found, message = text.partition("Status Message: ")
    reason = SOURCE.sub("", message if found else text.split(" : ")[-1])
    return reason if len(reason) <= MAX_REASON else reason[:MAX_REASON] + "..."


def _remedy(error: Exception) -> str:
    if isinstance(error, MemoryError) or any(sign in str(error) for sign in OUT_OF_MEMORY):
        return ": there is not enough memory; use fewer views or a smaller size"
    return "; is it damaged? export it again"
