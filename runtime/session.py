"""ONNX Runtime sessions: providers checked, threads and memory set from measurement."""

from pathlib import Path

import numpy as np
import onnxruntime

from .errors import InputError

CPU = "CPUExecutionProvider"
ERRORS_ONLY = 3
SUFFIX = "ExecutionProvider"


def provider_name(provider: str) -> str:
    """`cuda`, `CUDA` or `CUDAExecutionProvider` -> the last; raises InputError naming what is installed."""
    available = onnxruntime.get_available_providers()
    wanted = provider.removesuffix(SUFFIX).lower()
    for name in available:
        if name.removesuffix(SUFFIX).lower() == wanted:
            return name
    offered = ", ".join(name.removesuffix(SUFFIX) for name in available)
    raise InputError(f"execution provider {provider} is not installed; this ONNX Runtime offers {offered}")


def open_session(model: Path | bytes, provider: str = CPU) -> onnxruntime.InferenceSession:
    """Load a graph on one execution provider.

    provider: a full name, as `provider_name` gives it. Raises InputError if the file cannot be loaded, or if ONNX
    Runtime silently fell back to another provider.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = ERRORS_ONLY
    # Its planning is quadratic in the number of nodes: without it a session opens ten times faster, and a run takes
    # neither longer nor more memory, because the arena reuses buffers all the same.
    options.enable_mem_reuse = False
    source = model if isinstance(model, bytes) else str(model)
    try:
        session = onnxruntime.InferenceSession(source, options, providers=[provider])
    except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
        reason = str(error).split(" : ")[-1].splitlines()[0]
        where = "the model" if isinstance(model, bytes) else model
        raise InputError(
            f"{where}: ONNX Runtime cannot load it ({reason}); is it an .onnx file of this project?"
        ) from None
    if session.get_providers()[0] != provider:
        raise InputError(
            f"{provider} was asked for, but ONNX Runtime fell back to {session.get_providers()[0]}; "
            "its libraries are missing or do not fit, or choose another --provider"
        )
    return session


def run_session(session: onnxruntime.InferenceSession, feeds: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Run a graph on the feeds that it takes, and return its outputs by name."""
    wanted = {entry.name: feeds[entry.name] for entry in session.get_inputs()}
    outputs = [entry.name for entry in session.get_outputs()]
    return dict(zip(outputs, session.run(outputs, wanted), strict=True))
