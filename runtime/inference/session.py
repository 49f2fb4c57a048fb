"""ONNX Runtime sessions: their provider and its device, thread and memory settings, runs with a time limit."""

import io
import logging
import os
import re
import threading
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from ..errors import InputError, one_line
from ..system.files import check_regular
from .engine_cache import engine_folder
from .graph_cache import cache_entry
from .providers import (
    CPU,
    DEVICE_TYPES,
    Provider,
    choose_device,
    device_number,
    device_type,
    find_provider,
    is_built_in,
)

LOG = logging.getLogger(__name__)

# Errors reach the caller as exceptions; ONNX Runtime's own log would print them to the terminal a second time.
FATAL_ONLY = 4
AS_MANY_AS_CORES = 0  # threads
# Time limit of a run, so that a graph with an endless loop is stopped: several times what the slowest network takes on
# one core of a slow machine.
RUN_LIMIT_S = 900.0
RUN_LIMIT_S_PER_PIXEL = 2e-3  # of all views together
LIMIT_VARIABLE = "IDESPLAT_RUN_LIMIT"  # environment variable: seconds, instead of both
MAX_REASON = 300  # characters of ONNX Runtime's messages that are quoted
# The prefix of its messages: source file, line and function.
SOURCE = re.compile(r"^\S+\.(?:cc|h):\d+ .*?\) ")
OUT_OF_MEMORY = ("Failed to allocate memory", "bad_alloc", "bad allocation", "out of memory")

# Built-in providers with their options, as ONNX Runtime takes them; None where the session's options have a plug-in.
BuiltIn = list[tuple[str, dict[str, str]]] | None

onnxruntime.set_default_logger_severity(FATAL_ONLY)


@dataclass(frozen=True)
class SessionConfig:
    """How sessions are opened. The defaults are right but for benchmarks and profiling."""

    # None for all cores that the process may use.
    threads: int | None = None
    # Prefix of the file to which ONNX Runtime writes the time and the shapes of every operator; None for no profile.
    profile: Path | None = None
    # Whether ONNX Runtime optimises the graph.
    optimise: bool = True
    # Of a provider with several devices: a number, or the type "cpu", "gpu" or "npu"; None for its usual one.
    device: str | None = None
    # Options of the provider by name, which replace those that it gets by default (`providers.PROVIDERS`).
    provider_options: Mapping[str, str] = field(default_factory=dict)


DEFAULT = SessionConfig()


def open_session(
    model: Path | bytes, provider: Provider | str = CPU, config: SessionConfig = DEFAULT
) -> onnxruntime.InferenceSession:
    """Load a graph, from a file or its bytes, on one execution provider, given by itself or by name (`find_provider`).

    On the CPU a file's optimised graph is cached (`graph_cache`); providers that compile graphs keep engines
    (`engine_cache`). Raises InputError if the file cannot be loaded, the provider or the device is not there, or ONNX
    Runtime would fall back to another provider.
    """
    provider = find_provider(provider) if isinstance(provider, str) else provider
    if isinstance(model, Path):
        with suppress(OSError):  # ONNX Runtime says that there is no such file
            check_regular(model)
    options = _options(config)
    name = "a graph in memory" if isinstance(model, bytes) else model
    LOG.debug("opening %s on %s with %s", name, provider.name, config)
    if provider.ep_name == CPU:
        if config.device or config.provider_options:
            raise InputError("--device and --provider-option need --provider: the CPU provider has neither")
        if isinstance(model, Path) and config.optimise:
            cached = _open_cached(model, options)
            if cached is not None:
                return cached
    providers = _add_provider(options, model, provider, config)
    try:
        session = _create(model, options, providers)
    except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
        where = "the model" if isinstance(model, bytes) else model
        if provider.ep_name == CPU:
            lacking = f"ONNX Runtime cannot load it ({_reason(error)}); is it an .onnx file of this project?"
        else:
            lacking = f"{provider.name} cannot load it ({_reason(error)}); choose another --provider"
        raise InputError(f"{where}: {lacking}") from None
    if session.get_providers()[0] != provider.ep_name:
        raise InputError(
            f"{provider.name} was asked for, but ONNX Runtime fell back to {session.get_providers()[0]}; "
            "its libraries are missing or do not fit, or choose another --provider"
        )
    _log_placement(session, provider)
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
    # On x64 CPUs without VNNI, products of unsigned by signed 8-bit integers saturate, which makes int8 networks wrong;
    # with this, unsigned weights are used there. Other CPUs ignore it.
    options.add_session_config_entry("session.x64quantprecision", "1")
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


def _add_provider(
    options: onnxruntime.SessionOptions, model: Path | bytes, provider: Provider, config: SessionConfig
) -> BuiltIn:
    """Add a plug-in's device to the options of a session; returns the built-in providers that it is opened with."""
    if provider.ep_name == CPU:
        return [(CPU, {})]
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
    given = dict(config.provider_options)
    if is_built_in(provider):
        kind, description = "", f"device {config.device or 0}"
        if config.device is not None:
            given = _built_in_device(provider, config.device) | given
        device = None
    else:
        device = choose_device(provider, config.device)
        kind = device_type(device)
        description = f"{device.device.vendor} {device.device.device_id} {device.ep_metadata} {device.device.metadata}"
    cache = None
    if provider.caches and isinstance(model, Path):
        cache = engine_folder(model, provider, description, given)
    settings = provider.defaults(options.intra_op_num_threads, kind, cache) | given
    LOG.debug("options of %s: %s", provider.name, settings)
    if device is not None:
        options.add_provider_for_devices([device], settings)
        return None
    if provider.memory == "cuda" and hasattr(onnxruntime, "preload_dlls"):
        with redirect_stdout(io.StringIO()) as said:  # it prints what it does not find
            onnxruntime.preload_dlls()
        LOG.debug("loading the libraries of CUDA: %s", said.getvalue())
    return [(provider.ep_name, settings)]


def _built_in_device(provider: Provider, asked: str) -> dict[str, str]:
    """The option by which a provider that is no plug-in takes --device; raises InputError."""
    if not provider.device_option or asked.lower() in DEVICE_TYPES:
        takes = "the number of a device" if provider.device_option else "no device; see its --provider-option"
        raise InputError(f"--device {asked}: {provider.name} takes {takes}")
    return {provider.device_option: str(device_number(asked))}


def _create(
    model: Path | bytes,
    options: onnxruntime.SessionOptions,
    providers: BuiltIn,
) -> onnxruntime.InferenceSession:
    source = model if isinstance(model, bytes) else str(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a provider that is not there, which `open_session` raises for
        return onnxruntime.InferenceSession(source, options, providers=providers, enable_fallback=0)


def _log_placement(session: onnxruntime.InferenceSession, provider: Provider) -> None:
    """Log how many of the nodes run on the provider, and how many on the CPU because it has no kernel for them."""
    if provider.ep_name == CPU or not LOG.isEnabledFor(logging.INFO):
        return
    counts: Counter[str] = Counter()
    for part in getattr(session, "get_provider_graph_assignment_info", list)():
        counts[part.ep_name] += len(part.get_nodes())
    LOG.info("nodes by provider: %s", ", ".join(f"{name} {count}" for name, count in counts.most_common()))


def _open_cached(model: Path, options: onnxruntime.SessionOptions) -> onnxruntime.InferenceSession | None:
    """A session of the cached optimised graph, which is added to the cache if missing; None where that fails."""
    entry = cache_entry(model)
    if entry is None:
        return None

    def optimise(target: Path) -> onnxruntime.InferenceSession:
        options.optimized_model_filepath = str(target)
        return _create(model, options, [(CPU, {})])

    found = entry.get()
    LOG.info("%s: %s", model, f"its optimised graph is cached as {found}" if found else "optimising its graph, once")
    try:
        if found is None:
            return entry.put(optimise)
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        return _create(found, options, [(CPU, {})])
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
    feeds: Mapping[str, np.ndarray],
    outputs: Sequence[str] | None = None,
    limit_s: float | None = None,
) -> dict[str, np.ndarray]:
    """Run a graph and return its outputs, or those named, by name. Feeds that are not its inputs are ignored.

    limit_s: seconds after which the run is stopped; None for no limit. It is stopped between two operators: an operator
    that does not end cannot be.
    Raises InputError if an input is missing, the graph cannot run on these feeds, or it exceeds the limit.
    """
    wanted = _inputs_of(session, feeds)
    names = [entry.name for entry in session.get_outputs()] if outputs is None else list(outputs)
    with _limited(limit_s) as options:
        found = session.run(names, wanted, options)
    return dict(zip(names, found, strict=True))


def run_on_device(
    session: onnxruntime.InferenceSession,
    feeds: Mapping[str, Any],
    outputs: Sequence[str],
    limit_s: float | None,
    keep: Collection[str],
    memory: str,
) -> dict[str, Any]:
    """`run_session` with the outputs in `keep` left in the memory of the session's provider (`Provider.memory`).

    They are OrtValues, which feed another session on the same device without a copy; other outputs are arrays.
    """
    wanted = _inputs_of(session, feeds)
    binding = session.io_binding()
    with _limited(limit_s) as options:
        for name, value in wanted.items():
            if isinstance(value, np.ndarray):
                binding.bind_cpu_input(name, np.ascontiguousarray(value))
            else:
                binding.bind_ortvalue_input(name, value)
        for name in outputs:
            binding.bind_output(name, memory if name in keep else "cpu")
        session.run_with_iobinding(binding, options)
        found = dict(zip(outputs, binding.get_outputs(), strict=True))
        return {name: value if name in keep else value.numpy() for name, value in found.items()}


def _inputs_of(session: onnxruntime.InferenceSession, feeds: Mapping[str, Any]) -> dict[str, Any]:
    """The feeds that are inputs of the graph; raises InputError if one is missing."""
    missing = [entry.name for entry in session.get_inputs() if entry.name not in feeds]
    if missing:
        raise InputError(f"the graph needs the input {missing[0]}, which is not given; export the model again")
    return {entry.name: feeds[entry.name] for entry in session.get_inputs()}


@contextmanager
def _limited(limit_s: float | None) -> Iterator[onnxruntime.RunOptions]:
    """The options of a run that is stopped after the limit; its errors become InputErrors."""
    options = onnxruntime.RunOptions()
    options.log_severity_level = FATAL_ONLY
    ended = threading.Event()
    watchdog = _watchdog(options, ended, limit_s)
    try:
        yield options
    except Exception as error:  # of many kinds, as above; also out of memory
        if ended.is_set():
            late = f"the graph did not end within {limit_s:g} s and was stopped"
            raise InputError(f"{late}; allow more by the environment variable {LIMIT_VARIABLE}=SECONDS") from None
        raise InputError(f"ONNX Runtime cannot run the graph ({_reason(error)}){_remedy(error)}") from None
    finally:
        if watchdog is not None:
            watchdog.cancel()


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
    text = one_line(error)
    _, found, message = text.partition("Status Message: ")
    reason = SOURCE.sub("", message if found else text.split(" : ")[-1])
    return reason if len(reason) <= MAX_REASON else reason[:MAX_REASON] + "..."


def _remedy(error: Exception) -> str:
    if isinstance(error, MemoryError) or any(sign in str(error) for sign in OUT_OF_MEMORY):
        return ": there is not enough memory; use fewer views or a smaller size"
    return "; is it damaged? export it again"
