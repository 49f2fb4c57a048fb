"""OpenVINO as an execution provider, which runs a graph on the processor as a program of its own.

It comes as a plug-in to ONNX Runtime, in a package of its own (the extra `openvino`).
"""

import functools
import json
from importlib import import_module
from importlib.util import find_spec

import onnxruntime

from ..errors import InputError

PROVIDER = "OpenVINOExecutionProvider"
PACKAGE = "onnxruntime_ep_openvino"
# Left alone it computes in bfloat16 where a processor is quick at that, and depths move by more than half.
PRECISION = "f32"


def installed() -> bool:
    """Whether the plug-in is there."""
    return find_spec(PACKAGE) is not None


def add_openvino(options: onnxruntime.SessionOptions) -> None:
    """Have the sessions opened with these options run on OpenVINO in float32, on as many threads as they say.

    Raises InputError where the plug-in cannot be loaded, or finds no processor that it runs on.
    """
    settings = {"INFERENCE_PRECISION_HINT": PRECISION}
    if options.intra_op_num_threads:
        settings["INFERENCE_NUM_THREADS"] = str(options.intra_op_num_threads)
    try:
        _register()
    except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
        reason = str(error).split(" : ")[-1].splitlines()[0]
        raise InputError(f"OpenVINO's plug-in cannot be loaded ({reason}); use --provider CPU") from None
    devices = [device for device in onnxruntime.get_ep_devices() if _is_processor(device)]
    if not devices:
        raise InputError("OpenVINO's plug-in runs on Intel's processors alone, and finds none here; use --provider CPU")
    options.add_provider_for_devices(devices[:1], {"load_config": json.dumps({"CPU": settings})})


@functools.cache
def _register() -> None:
    """Load the plug-in, which ONNX Runtime takes once in a process."""
    onnxruntime.register_execution_provider_library(PROVIDER, import_module(PACKAGE).get_library_path())


def _is_processor(device: onnxruntime.OrtEpDevice) -> bool:
    """Whether it is the processor as OpenVINO itself runs on it, and not through one of its pseudo-devices."""
    return device.ep_name == PROVIDER and device.device.type == onnxruntime.OrtHardwareDeviceType.CPU
