"""OpenVINO as an execution provider: asked for by name, in float32, and equal to ONNX Runtime's own operators."""

import json
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
from conftest import run_command
from idesplat import Predictor
from idesplat.export.example_inputs import example_inputs
from idesplat.runtime.cli import infer as cli
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference import openvino
from idesplat.runtime.inference.metadata import INPUTS
from idesplat.runtime.inference.session import provider_name


class Options:
    """Session options that note what is asked of them."""

    def __init__(self, threads: int) -> None:
        self.intra_op_num_threads = threads
        self.asked = None

    def add_provider_for_devices(self, devices, settings) -> None:
        self.asked = devices, json.loads(settings["load_config"])


def device(name: str, kind: str):
    return SimpleNamespace(ep_name=name, device=SimpleNamespace(type=getattr(onnxruntime.OrtHardwareDeviceType, kind)))


@pytest.fixture
def found(monkeypatch):
    """Replaces what the plug-in finds."""
    monkeypatch.setattr(openvino, "_register", lambda: None)
    return lambda *devices: monkeypatch.setattr(onnxruntime, "get_ep_devices", lambda: list(devices))


def test_without_the_extra_the_remedy_is_named(monkeypatch, scene, tmp_path, exported, capsys):
    monkeypatch.setattr(openvino, "find_spec", lambda name: None)
    out = tmp_path / "scene.ply"
    arguments = ("--images", scene / "images", "--cameras", scene / "transforms.json", "--out", out)
    assert run_command(cli.main, "--model", exported[0], "--provider", "OpenVINO", *arguments) == 2
    printed = capsys.readouterr().err
    assert printed == "error: execution provider OpenVINO is not installed; pip install 'idesplat[openvino]'\n"
    assert not out.exists()


@pytest.mark.parametrize("name", ["openvino", "OpenVINO", "OpenVINOExecutionProvider"])
def test_it_is_chosen_by_name(name, monkeypatch):
    monkeypatch.setattr(openvino, "find_spec", lambda name: object())
    assert provider_name(name) == openvino.PROVIDER


@pytest.mark.parametrize(
    "others", [(), (device("CPUExecutionProvider", "CPU"), device("OpenVINOExecutionProvider.AUTO", "CPU"))]
)
def test_without_a_supported_cpu_it_is_refused(others, found, exported):
    found(*others)
    with pytest.raises(InputError, match=r"^OpenVINO's plug-in runs on Intel CPUs only, .* --provider CPU$"):
        Predictor(exported[0], "OpenVINO")


def test_a_plug_in_that_cannot_be_loaded_is_refused_in_one_line(monkeypatch, exported):
    def fail() -> None:
        raise RuntimeError("[ONNXRuntimeError] : 1 : FAIL : no such library\nand more")

    monkeypatch.setattr(openvino, "_register", fail)
    with pytest.raises(InputError, match=r"^OpenVINO's plug-in cannot be loaded \(no such library\); use .*CPU$"):
        Predictor(exported[0], "OpenVINO")


@pytest.mark.parametrize("threads", [0, 3])
def test_it_computes_in_float32_on_the_cpu(threads, found):
    """Where it is quick at bfloat16 it would take that, left alone."""
    wanted = device(openvino.PROVIDER, "CPU")
    found(device("CPUExecutionProvider", "CPU"), device(openvino.PROVIDER, "GPU"), wanted)
    options = Options(threads)
    openvino.add_openvino(options)
    count = {"INFERENCE_NUM_THREADS": "3"} if threads else {}
    assert options.asked == ([wanted], {"CPU": {"INFERENCE_PRECISION_HINT": "f32", **count}})


def test_it_computes_the_same(exported):
    pytest.importorskip(openvino.PACKAGE)
    try:
        predictor = Predictor(exported[0], "OpenVINO")
    except InputError as error:
        pytest.skip(str(error))  # on a CPU that is not Intel's
    inputs = example_inputs(3, 64, 96, 0.5, 100.0)
    arrays = [inputs[name].numpy() for name in INPUTS]
    expected, found = Predictor(exported[0]).predict_arrays(*arrays), predictor.predict_arrays(*arrays)
    for name in ("means", "scales", "opacities", "sh"):
        ours, theirs = getattr(expected.gaussians, name), getattr(found.gaussians, name)
        assert np.median(np.abs(theirs - ours)) < 1e-4 * ours.std(), name
    assert np.median(np.abs(found.depth / expected.depth - 1)) < 1e-4
