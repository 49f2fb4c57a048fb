"""Options of the export: opset, weights in a file, no verification, hub folders, calibration on images."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from conftest import run_command
from depthsplat_cases import ONE_SCALE
from idesplat import Predictor, export_checkpoint
from idesplat.export import cli
from idesplat.export.calibration_images import read_examples
from idesplat.export.example_inputs import example_inputs
from idesplat.export.targets import GraphSettings
from idesplat.model.depthsplat.network import DepthSplat
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.metadata import INPUTS, ModelMetadata
from tiny_model import OWN

INPUT_TENSORS = example_inputs(2, 64, 64, 0.5, 100.0)


def depth(path: Path) -> np.ndarray:
    arrays = [value.numpy() for value in INPUT_TENSORS.values()]
    return Predictor(path).predict_arrays(*arrays[: len(INPUTS)]).depth


@pytest.fixture(scope="module")
def network() -> Iterator[DepthSplat]:
    """A small network that is quickly exported, as a preset of its own."""
    torch.manual_seed(0)
    PRESETS["depthsplat-small-one"] = ONE_SCALE
    yield build(ONE_SCALE).eval()
    del PRESETS["depthsplat-small-one"]


@pytest.fixture(scope="module")
def checkpoint(network, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "depthsplat-small-one.pth"
    torch.save(network.state_dict(), path)
    return path


@pytest.fixture(scope="module")
def hub(checkpoint, kept_traces, tmp_path_factory) -> Path:
    """A folder with the graph and one more in int8-qdq, both without verification."""
    folder = tmp_path_factory.mktemp("hub") / "model"
    for precision in ("float32", "int8-qdq"):
        arguments = ("--hub", folder, "--precision", precision, "--no-verify")
        assert run_command(cli.main, checkpoint, *arguments) == 0
    return folder


def test_a_hub_folder_has_graphs_configuration_card_and_checksums(hub: Path) -> None:
    files = {path.relative_to(hub).as_posix() for path in hub.rglob("*") if path.is_file()}
    assert files == {"README.md", "SHA256SUMS", "config.json", "onnx/model.onnx", "onnx/model_int8_qdq.onnx"}
    sums = dict(reversed(line.split("  ")) for line in (hub / "SHA256SUMS").read_text().splitlines())
    assert sums == {
        name: hashlib.sha256((hub / name).read_bytes()).hexdigest() for name in files if name.endswith(".onnx")
    }
    config = json.loads((hub / "config.json").read_text())
    assert config["graphs"] == ["onnx/model.onnx", "onnx/model_int8_qdq.onnx"]
    assert config["sh_degree"] == 2 and config["size_multiple"] == 16
    card = (hub / "README.md").read_text()
    assert "not verified" in card and all(digest in card for digest in sums.values())
    assert card.startswith("---\n")


def test_graphs_of_a_hub_folder_run(hub: Path, network: DepthSplat) -> None:
    with torch.no_grad():
        expected = network(*INPUT_TENSORS.values()).depth.numpy()
    np.testing.assert_allclose(depth(hub / "onnx" / "model.onnx"), expected, rtol=1e-3)
    off = np.median(np.abs(1 / depth(hub / "onnx" / "model_int8_qdq.onnx") - 1 / expected)) / (1 / expected).std()
    assert 0 < off < 0.2


def test_int8_qdq_is_symmetric_with_weights_by_channel(hub: Path) -> None:
    graph = onnx.load(hub / "onnx" / "model_int8_qdq.onnx").graph
    constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    quantized = [node for node in graph.node if node.op_type in ("QuantizeLinear", "DequantizeLinear")]
    zeros = [constants[node.input[2]] for node in quantized]
    assert {zero.dtype for zero in zeros} == {np.dtype(np.int8)}
    assert not any(zero.any() for zero in zeros)
    weights = [node for node in quantized if node.input[0] in constants]
    assert {constants[node.input[1]].ndim for node in weights} == {1}
    readers = {node.op_type for node in graph.node if any(name.endswith(".dequantized") for name in node.input)}
    assert {"Conv", "MatMul"} <= readers <= {"Conv", "ConvTranspose", "MatMul"}


@pytest.mark.slow
@pytest.mark.parametrize(("opset", "ir_version"), ((17, 8), (21, 10)))
def test_other_opsets_and_weights_in_a_file(opset, ir_version, checkpoint, hub, kept_traces, tmp_path, capsys) -> None:
    capsys.readouterr()
    path = tmp_path / "model.onnx"
    arguments = ("--opset", opset, "--no-verify", "--external-data")
    assert run_command(cli.main, checkpoint, path, *arguments) == 0
    printed = capsys.readouterr()
    assert "not compared with PyTorch" in printed.err
    (weights,) = tmp_path.glob("*.data")
    assert f"{weights.name} holds the weights" in printed.out
    assert path.stat().st_size < weights.stat().st_size
    model = onnx.load(path)
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", opset)]
    assert model.ir_version == ir_version
    np.testing.assert_allclose(depth(path), depth(hub / "onnx" / "model.onnx"), rtol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    (
        (("out.onnx", "--target", "phone"), "--target phone: unknown; choose one of cpu, gpu, web"),
        (("out.onnx", "--opset", "16"), "--opset 16: expected 17 to 21"),
        (("out.onnx", "--hub", "hub"), "with --hub the graph's name is given by its precision"),
        (("out.onnx", "--precision", "int8", "--calibrate", "photos"), "--calibrate and --cameras belong together"),
        (("out.onnx", "--calibrate", "a", "--cameras", "b"), "--calibrate: float32 has no ranges to find"),
    ),
)
def test_errors_are_one_line(arguments, expected, small_checkpoint, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command(cli.main, small_checkpoint, *arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ") and expected in message and message.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_hub_folder_that_others_wrote_into_is_kept(small_checkpoint, tmp_path, capsys) -> None:
    (tmp_path / "README.md").write_text("mine")
    assert run_command(cli.main, small_checkpoint, "--hub", tmp_path) == 2
    assert "idesplat did not write it" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "mine"


def test_calibration_inputs_are_what_inference_would_prepare(scene: Path) -> None:
    metadata = ModelMetadata(**{**vars(OWN), "near": 0.5})
    groups = read_examples(scene / "images", scene / "transforms.json", metadata)
    assert len(groups) == 5
    for feeds in groups:
        assert list(feeds) == list(INPUTS)
        assert feeds["images"].shape == (2, 3, 64, 96)
        assert feeds["near"] == pytest.approx(0.5)
        np.testing.assert_allclose(feeds["extrinsics"][:, :3, 3].mean(0), 0, atol=1e-5)


def test_too_few_calibration_images_for_a_static_graph_are_refused(scene: Path) -> None:
    metadata = ModelMetadata(**{**vars(OWN), "fixed_views": 6})
    with pytest.raises(InputError, match=r"--calibrate .*: 5 images with cameras, and the graph takes 6 views; add"):
        read_examples(scene / "images", scene / "transforms.json", metadata)


def test_ranges_are_found_on_the_images(hub, checkpoint, kept_traces, scene, tmp_path) -> None:
    """Beside those of noise in the hub folder."""

    def scales(path: Path) -> dict[str, float]:
        tensors = onnx.load(path).graph.initializer
        return {
            t.name: float(onnx.numpy_helper.to_array(t)) for t in tensors if t.name.endswith(".scale") and not t.dims
        }

    path, images = tmp_path / "model.onnx", scene / "images"
    calibration = {"calibrate": images, "cameras": scene / "transforms.json"}
    export_checkpoint(checkpoint, path, precision="int8-qdq", verify=False, **calibration)
    on_noise, on_images = map(scales, (hub / "onnx" / "model_int8_qdq.onnx", path))
    assert on_noise.keys() == on_images.keys() and on_noise != on_images


def test_defaults() -> None:
    assert GraphSettings().target.name == "cpu" and GraphSettings().opset == 20
