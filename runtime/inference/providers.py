"""Execution providers of ONNX Runtime: what is known of each, which are installed, and which devices they offer.

A provider is part of a build of ONNX Runtime, or a plug-in: a package of its own, whose library ONNX Runtime loads.
"""

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distributions, version
from importlib.util import find_spec
from pathlib import Path

import onnxruntime

from ..errors import InputError

AUTO = "auto"
CPU = "CPUExecutionProvider"
SUFFIX = "ExecutionProvider"
PLUG_IN_PREFIX = "onnxruntime-ep-"  # of the packages of plug-ins
# Of providers that send a model to another machine; nothing here does.
REMOTE = ("AzureExecutionProvider",)
DEVICE_TYPES = ("cpu", "gpu", "npu")
DOCUMENTATION_ALONE = "no, from its documentation alone"

# Of a session: threads (0 for the provider's choice), type of the device, and the folder for compiled engines, if any.
Defaults = Callable[[int, str, Path | None], dict[str, str]]


def _no_defaults(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    return {}


@dataclass(frozen=True)
class Provider:
    """One execution provider.

    name: as `--provider` takes it. ep_name: ONNX Runtime's name for it. package: what to install. module: the Python
    module of a plug-in; None where the provider is part of a build of ONNX Runtime. hardware: what it runs on.
    tried: what of it was run while it was written, for the table of providers.
    defaults: the options that it gets unless the user gives others. device_option: the option that takes the number of
    a device, where the provider is no plug-in. device: the type of device that it takes by default; any if empty.
    memory: ONNX Runtime's name of the memory in which its outputs can stay; empty where they are in the CPU's.
    caches: whether compiled engines can be kept in a folder.
    """

    name: str
    ep_name: str
    package: str
    hardware: str
    module: str | None = None
    tried: str = DOCUMENTATION_ALONE
    defaults: Defaults = _no_defaults
    device_option: str = ""
    device: str = ""
    memory: str = ""
    caches: bool = False

    @property
    def version(self) -> str:
        """The version of the installed package; empty if it is not installed."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return ""


def _webgpu(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    # In the layout that it prefers by itself, convolutions of some numbers of input channels are wrong, such as 18
    # (version 0.4.0; microsoft/onnxruntime#29651).
    return {"preferredLayout": "NCHW"}


def _openvino(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    # By default it computes in bfloat16 on CPUs with bfloat16 instructions, which changes depths by more than half.
    settings = {"INFERENCE_PRECISION_HINT": "f32"}
    if threads and device == "cpu":
        settings["INFERENCE_NUM_THREADS"] = str(threads)
    if cache is not None:
        settings["CACHE_DIR"] = str(cache)
    return {"load_config": json.dumps({device.upper(): settings})}


def _cuda(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    return {"use_tf32": "0"}  # 10 bits of mantissa, by default, are too few for geometry


def _tensorrt(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    if cache is None:
        return {}
    return {
        "trt_engine_cache_enable": "1",
        "trt_engine_cache_path": str(cache),
        "trt_timing_cache_enable": "1",
        "trt_timing_cache_path": str(cache),
    }


def _tensorrt_rtx(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    return {} if cache is None else {"nv_runtime_cache_path": str(cache)}


def _coreml(threads: int, device: str, cache: Path | None) -> dict[str, str]:
    # An ML program computes in the graph's float32; the older format computes in half precision on most devices.
    return {"ModelFormat": "MLProgram"} | ({} if cache is None else {"ModelCacheDirectory": str(cache)})


PROVIDERS = (
    Provider("CPU", CPU, "onnxruntime", "every CPU", tried="yes: all results and all tests"),
    Provider(
        *("WebGPU", "WebGpuExecutionProvider", "onnxruntime-ep-webgpu", "GPUs with Vulkan, Direct3D 12 or Metal"),
        module="onnxruntime_ep_webgpu",
        tried="0.4.0 on a software adapter alone",
        defaults=_webgpu,
        memory="gpu",
    ),
    Provider(
        *("OpenVINO", "OpenVINOExecutionProvider", "onnxruntime-ep-openvino", "Intel CPUs, GPUs and NPUs"),
        module="onnxruntime_ep_openvino",
        tried="1.8.1 on an AMD CPU, its vendor check removed",
        defaults=_openvino,
        device="cpu",
        caches=True,
    ),
    Provider(
        *("CUDA", "CUDAExecutionProvider", "onnxruntime-gpu", "NVIDIA GPUs"),
        defaults=_cuda,
        device_option="device_id",
        memory="cuda",
    ),
    Provider(
        *("TensorRT", "TensorrtExecutionProvider", "onnxruntime-gpu", "NVIDIA GPUs, with TensorRT installed"),
        defaults=_tensorrt,
        device_option="device_id",
        memory="cuda",
        caches=True,
    ),
    Provider(
        *("TensorRT-RTX", "NvTensorRTRTXExecutionProvider", "onnxruntime-ep-nv-tensorrt-rtx", "NVIDIA RTX GPUs"),
        module="onnxruntime_ep_nv_tensorrt_rtx",
        defaults=_tensorrt_rtx,
        memory="cuda",
        caches=True,
    ),
    Provider(
        *("DirectML", "DmlExecutionProvider", "onnxruntime-directml", "GPUs on Windows"),
        device_option="device_id",
        memory="dml",
    ),
    Provider(
        *("CoreML", "CoreMLExecutionProvider", "onnxruntime", "Apple's GPUs and Neural Engine, on macOS"),
        defaults=_coreml,
        caches=True,
    ),
    Provider(
        *("MLX", "MLXExecutionProvider", "onnxruntime-ep-mlx", "GPUs of Apple silicon"), module="onnxruntime_ep_mlx"
    ),
    Provider(
        *("QNN", "QNNExecutionProvider", "onnxruntime-qnn", "Qualcomm's NPUs and GPUs"),
        module="onnxruntime_qnn",
        device="npu",
    ),
)
# What `auto` tries, in this order, before the CPU: GPUs that run a graph without compiling it for minutes.
AUTOMATIC = ("CUDA", "DirectML", "WebGPU")


def find_provider(text: str) -> Provider:
    """The provider that is called `webgpu`, `WebGPU` or `WebGpuExecutionProvider`.

    Raises InputError that names what to install, or what is known.
    """
    wanted = _plain(text)
    for provider in _known():  # those of the table first: finding others reads the metadata of all packages
        if wanted in (_plain(provider.name), _plain(provider.ep_name)):
            if not is_installed(provider):
                instead = " instead of onnxruntime" if _replaces_onnxruntime(provider) else ""
                there = ", ".join(other.name for other in _known() if is_installed(other))
                raise InputError(
                    f"execution provider {provider.name} is not installed; pip install {provider.package}{instead} "
                    f"(for {provider.hardware}; installed: {there})"
                )
            return provider
    names = ", ".join(provider.name for provider in _known())
    raise InputError(f"execution provider {text}: unknown; choose {AUTO} or one of {names}")


def candidates(text: str) -> list[Provider]:
    """The provider of this name; for `auto` those to try, best first, of which the last is the CPU.

    Raises InputError as `find_provider` does.
    """
    if text.lower() != AUTO:
        return [find_provider(text)]
    found = [provider for name in AUTOMATIC for provider in PROVIDERS if provider.name == name and _has_gpu(provider)]
    return [*found, find_provider(CPU)]


def all_providers() -> list[Provider]:
    """Every provider in the table, and others that are installed."""
    return list(_known())


def is_built_in(provider: Provider) -> bool:
    """Whether the installed build of ONNX Runtime contains it; once loaded, plug-ins are listed as available, too."""
    return provider.ep_name in onnxruntime.get_available_providers() and not _has_plug_in(provider)


def is_installed(provider: Provider) -> bool:
    """Whether it is built in, its plug-in is installed, or ONNX Runtime has loaded a plug-in of its own for it."""
    if is_built_in(provider) or _has_plug_in(provider):
        return True
    return any(device.ep_name == provider.ep_name for device in _ep_devices())


def devices_of(provider: Provider) -> "list[onnxruntime.OrtEpDevice]":
    """The devices that a plug-in offers on this machine, after loading it.

    Only those of exactly this name: virtual devices that distribute work, such as `OpenVINOExecutionProvider.AUTO`,
    have longer ones. Raises InputError if its library cannot be loaded.
    """
    if provider.module is not None and _has_plug_in(provider):
        try:
            _register(provider.ep_name, provider.module)
        except Exception as error:  # of many kinds, all derived from Exception alone
            reason = str(error).split(" : ")[-1].splitlines()[0]
            raise InputError(
                f"the plug-in of {provider.name} cannot be loaded ({reason}); install {provider.package} again, or use "
                "--provider CPU"
            ) from None
    return [device for device in _ep_devices() if device.ep_name == provider.ep_name]


def choose_device(provider: Provider, asked: str | None) -> "onnxruntime.OrtEpDevice":
    """The device of a plug-in that `--device` asks for: its number, or its type `cpu`, `gpu` or `npu`.

    Raises InputError where there is none.
    """
    devices = devices_of(provider)
    if not devices:
        raise InputError(
            f"{provider.name} finds no device here, it runs on {provider.hardware}; use --provider CPU, or install the "
            "driver"
        )
    offered = ", ".join(f"{index} ({device_type(device)})" for index, device in enumerate(devices))
    if asked is None:
        matching = [device for device in devices if device_type(device) == provider.device] if provider.device else []
        return (matching or devices)[0]
    if asked.lower() in DEVICE_TYPES:
        devices = [device for device in devices if device_type(device) == asked.lower()]
        number = 0
    else:
        number = device_number(asked)
    if number >= len(devices):
        raise InputError(f"--device {asked}: {provider.name} has no such device here; choose {offered}")
    return devices[number]


def device_number(asked: str) -> int:
    """The value of --device as a number; raises InputError."""
    if not (asked.isascii() and asked.isdigit()):
        raise InputError(f"--device {asked}: expected the number of a device, such as 0, or {', '.join(DEVICE_TYPES)}")
    return int(asked)


def device_type(device: "onnxruntime.OrtEpDevice") -> str:
    """The type of a plug-in's device: `cpu`, `gpu` or `npu`."""
    return str(device.device.type).rpartition(".")[2].lower()


def parse_provider_options(texts: Sequence[str]) -> Mapping[str, str]:
    """The options of `--provider-option NAME=VALUE`; raises InputError for one that is not of this form."""
    options = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise InputError(f"--provider-option {text}: expected NAME=VALUE, such as device_id=0")
        options[name] = value
    return options


def _known() -> Iterator[Provider]:
    """The table; then plug-ins and providers that are installed and not in it."""
    yield from PROVIDERS
    names = {provider.ep_name for provider in PROVIDERS}
    packages = {provider.package for provider in PROVIDERS}
    for package in sorted({distribution.name for distribution in distributions()} - packages):
        if package.startswith(PLUG_IN_PREFIX) and (provider := _unknown_plug_in(package)) is not None:
            names.add(provider.ep_name)
            yield provider
    for name in onnxruntime.get_available_providers():
        if name not in names and name not in REMOTE:
            yield Provider(name.removesuffix(SUFFIX), name, "onnxruntime", "see its documentation", tried="no")


def _unknown_plug_in(package: str) -> Provider | None:
    """A plug-in that follows ONNX Runtime's guidance for packages: a module with get_ep_name() and get_library_path().

    None for a package without such a module, as those are that only require another.
    """
    module = package.replace("-", "_")
    if find_spec(module) is None:
        return None
    name = import_module(module).get_ep_name()
    return Provider(name.removesuffix(SUFFIX), name, package, "see its documentation", module, tried="no")


def _replaces_onnxruntime(provider: Provider) -> bool:
    """Whether its package is another build of ONNX Runtime, which must not be installed beside the first."""
    return provider.module is None and provider.package != "onnxruntime"


def _has_plug_in(provider: Provider) -> bool:
    return provider.module is not None and find_spec(provider.module) is not None


def _has_gpu(provider: Provider) -> bool:
    """Whether a provider is installed and finds a GPU; of one that is built in, only opening a session tells."""
    if is_built_in(provider):
        return True
    try:
        return is_installed(provider) and any(device_type(device) == "gpu" for device in devices_of(provider))
    except InputError:
        return False


def _plain(name: str) -> str:
    return name.removesuffix(SUFFIX).lower().replace("-", "")


def _ep_devices() -> "list[onnxruntime.OrtEpDevice]":
    return list(onnxruntime.get_ep_devices()) if hasattr(onnxruntime, "get_ep_devices") else []


@functools.cache
def _register(ep_name: str, module: str) -> None:
    """Load a plug-in's library, which ONNX Runtime accepts once per process."""
    plug_in = import_module(module)
    path = getattr(plug_in, "get_library_path", None) or plug_in.library_path  # MLX's name for it
    onnxruntime.register_execution_provider_library(ep_name, path())
