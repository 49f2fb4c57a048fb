"""OpenVINO as an execution provider on Intel CPUs.

It is a plug-in of ONNX Runtime in a separate package (extra `openvino`).
"""

import functools
import json
from importlib import import_module
from importlib.util import find_spec

import onnxruntime

from ..errors import InputError

PROVIDER = "OpenVINOExecutionProvider"
PACKAGE = "onnxruntime_ep_openvino"
# By default it computes in bfloat16 on CPUs with bfloat16 instructions, which changes depths by more than half.
PRECISION = "f32"


def installed() -> bool:
    """Whether the plug-in is installed."""
    return find_spec(PACKAGE) is not None


def add_openvino(options: onnxruntime.SessionOptions) -> None:
    """Let sessions opened with these options run on OpenVINO in float32, with the options' number of threads.

    Raises InputError where the plug-in cannot be loaded, or supports no CPU of this machine.
    """
    settings = {"INFERENCE_PRECISION_HINT": PRECISION}
    if options.intra_op_num_threads:
        settings["INFERENCE_NUM_THREADS"] = str(options.intra_op_num_threads)
    try:
        _register()
    except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
        reason = str(error).split(" : ")[-1].splitlines()[0]
        raise InputError(f"OpenVINO's plug-in cannot be loaded ({reason}); use --provider CPU") from None
    devices = [device for device in onnxruntime.get_ep_devices() if _is_cpu(device)]
    if not devices:
        raise InputError("OpenVINO's plug-in runs on Intel CPUs only, and finds none here; use --provider CPU")
    options.add_provider_for_devices(devices[:1], {"load_config": json.dumps({"CPU": settings})})


@functools.cache
def _register() -> None:
    """Register the plug-in, which ONNX Runtime accepts once per process."""
    onnxruntime.register_execution_provider_library(PROVIDER, import_module(PACKAGE).get_library_path())


def _is_cpu(device: onnxruntime.OrtEpDevice) -> bool:
    """Whether the device is the CPU itself, not one of OpenVINO's virtual devices."""
    return device.ep_name == PROVIDER and device.device.type == onnxruntime.OrtHardwareDeviceType.CPU
