"""Model repositories of Triton: checked against its schema and the graphs, and run as the configurations say."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from conftest import run_command
from google.protobuf import text_format
from idesplat.export import cli
from idesplat.export.example_inputs import example_inputs
from idesplat.export.triton import GRAPH, STAGED, repository_files, write_repository
from idesplat.runtime.inference.metadata import INPUTS, OUTPUTS, StageFile, write_manifest
from tiny_model import NETWORK, OWN, write_model
from tritonclient.grpc.model_config_pb2 import ModelConfig

NAME = "idesplat-small"
STAGES = ("encoder", "dpbu1", "dpbu2", "dpbu3", "gaussians")
# ONNX Runtime's names of types, and Triton's, from its documentation of model configurations.
TYPES = {"tensor(float)": "TYPE_FP32", "tensor(int64)": "TYPE_INT64", "tensor(bool)": "TYPE_BOOL"}


@pytest.fixture(scope="module")
def repository(small_checkpoint, presets, kept_traces, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("triton") / "models"
    assert run_command(cli.main, small_checkpoint, "--triton", folder, "--no-verify") == 0
    return folder


def configuration(model: Path) -> ModelConfig:
    """The configuration of a model; a field that Triton's schema lacks is an error."""
    return text_format.Parse((model / "config.pbtxt").read_text(), ModelConfig())


@cache
def session(model: Path) -> onnxruntime.InferenceSession:
    path = model / "1" / configuration(model).default_model_filename
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def described(values) -> dict[str, tuple[int, tuple[int, ...]]]:
    """The types and shapes of a configuration's tensors."""
    return {value.name: (value.data_type, tuple(value.dims)) for value in values}


def found(values) -> dict[str, tuple[int, tuple[int, ...]]]:
    """The same of a graph's tensors, as ONNX Runtime has them."""
    schema = ModelConfig.DESCRIPTOR.file.enum_types_by_name["DataType"]
    return {
        value.name: (
            schema.values_by_name[TYPES[value.type]].number,
            tuple(size if isinstance(size, int) else -1 for size in value.shape),
        )
        for value in values
    }


def test_the_repository_has_a_folder_for_each_model(repository: Path) -> None:
    assert {path.name for path in repository.iterdir()} == {
        NAME,
        f"{NAME}-ensemble",
        *(f"{NAME}-{stage}" for stage in STAGES),
    }
    for model in repository.iterdir():
        config = configuration(model)
        assert config.name == model.name
        assert config.max_batch_size == 0
        assert (model / "1").is_dir()
        assert sum(path.suffix == ".onnx" for path in (model / "1").iterdir()) == (config.platform != "ensemble")


@pytest.mark.parametrize("model", [NAME, *(f"{NAME}-{stage}" for stage in STAGES)])
def test_configurations_describe_the_graphs(repository: Path, model: str) -> None:
    config, graph = configuration(repository / model), session(repository / model)
    assert config.backend == "onnxruntime"
    assert described(config.input) == found(graph.get_inputs())
    assert described(config.output) == found(graph.get_outputs())


def test_views_and_sizes_are_dynamic(repository: Path) -> None:
    config = configuration(repository / NAME)
    assert described(config.input)["images"][1] == (-1, 3, -1, -1)
    assert [value.name for value in config.input] == list(INPUTS)
    assert [value.name for value in config.output] == list(OUTPUTS)


def test_the_ensemble_connects_tensors_that_fit(repository: Path) -> None:
    """What Triton checks when it loads an ensemble."""
    ensemble = configuration(repository / f"{NAME}-ensemble")
    fused = configuration(repository / NAME)
    known, read = described(ensemble.input), set()
    for step in ensemble.ensemble_scheduling.step:
        config = configuration(repository / step.model_name)
        assert step.model_version == -1
        assert set(step.input_map) == {value.name for value in config.input}
        for name, tensor in step.input_map.items():
            assert known[tensor] == described(config.input)[name], tensor
            read.add(tensor)
        for name, tensor in step.output_map.items():
            assert tensor not in known
            known[tensor] = described(config.output)[name]
    assert read >= {value.name for value in ensemble.input}
    for name, value in described(ensemble.output).items():
        assert known[name] == value == described(fused.output)[name]
    assert {value.name for value in ensemble.output} == set(OUTPUTS)


@pytest.mark.parametrize("views", [2, 3])
def test_the_ensemble_computes_what_the_fused_graph_does(repository: Path, views: int) -> None:
    arrays = [value.numpy() for value in example_inputs(views, 64, 96, 0.5, 100.0).values()]
    inputs = dict(zip(INPUTS, arrays, strict=False))
    ensemble = configuration(repository / f"{NAME}-ensemble")
    tensors = {value.name: inputs[value.name] for value in ensemble.input}
    for step in ensemble.ensemble_scheduling.step:
        graph, names = session(repository / step.model_name), list(step.output_map)
        given = {name: tensors[tensor] for name, tensor in step.input_map.items()}
        for name, values in zip(names, graph.run(names, given), strict=True):
            tensors[step.output_map[name]] = values
    expected = session(repository / NAME).run([value.name for value in ensemble.output], inputs)
    for value, expectation in zip(ensemble.output, expected, strict=True):
        assert tensors[value.name].shape[0] in (views, views * 64 * 96)
        np.testing.assert_allclose(tensors[value.name], expectation, rtol=1e-4, atol=1e-4, err_msg=value.name)


def test_models_can_be_added_and_fixed_sizes_are_kept(tmp_path: Path) -> None:
    """A network of one stage, for which graphs of a few nodes stand in."""
    fixed = NETWORK.replace("float[views, 3, height, width] images", "float[2, 3, 64, 96] images")
    for precision, text in (("float32", NETWORK), ("int8", fixed)):
        staged = tmp_path / precision / STAGED
        staged.mkdir(parents=True)
        metadata = replace(OWN, precision=precision)
        write_model(tmp_path / precision / GRAPH, text)
        write_model(staged / "only.onnx", text)
        write_manifest(staged, [StageFile("only", "only.onnx", list(INPUTS), list(OUTPUTS))])
        written = write_repository(tmp_path / "models", tmp_path / precision, metadata)
        expected = repository_files(tmp_path / "models", metadata, ["only"])
        assert {path / "config.pbtxt" for path in written} == {path for path in expected if path.suffix == ".pbtxt"}
        assert all(path.is_file() for path in expected)
    models = tmp_path / "models"
    names = [f"tiny{precision}{part}" for precision in ("", "-int8") for part in ("", "-ensemble", "-only")]
    assert sorted(path.name for path in models.iterdir()) == sorted(names)
    for name in names:
        images = described(configuration(models / name).input)["images"][1]
        assert images == ((2, 3, 64, 96) if "int8" in name else (-1, 3, -1, -1))


def test_files_of_others_are_kept(small_checkpoint, repository: Path, capsys) -> None:
    for arguments in (("--triton", repository, "model.onnx"), ("--triton", repository, "--staged", "staged")):
        assert run_command(cli.main, small_checkpoint, *arguments) == 2
        assert "leave out OUT, --staged" in capsys.readouterr().err
    before = (repository / NAME / "config.pbtxt").read_bytes()
    (repository / NAME / "config.pbtxt").write_text("edited by hand")
    assert run_command(cli.main, small_checkpoint, "--triton", repository, "--no-verify") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (repository / NAME / "config.pbtxt").read_text() == "edited by hand"
    (repository / NAME / "config.pbtxt").write_bytes(before)


def test_a_field_that_triton_does_not_know_is_found(repository: Path, tmp_path: Path) -> None:
    text = (repository / NAME / "config.pbtxt").read_text()
    (tmp_path / "config.pbtxt").write_text(text.replace("max_batch_size", "max_batches"))
    with pytest.raises(text_format.ParseError):
        configuration(tmp_path)
