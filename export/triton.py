"""A model repository of NVIDIA Triton: the fused graph, and an ensemble of the graphs of the stages.

    DIR/NAME/config.pbtxt, 1/model.onnx                  the fused graph
    DIR/NAME-STAGE/config.pbtxt, 1/STAGE.onnx            each stage
    DIR/NAME-ensemble/config.pbtxt, 1/                   what runs the stages one after the other

Names, types and shapes of tensors are those of the graphs: what is dynamic there is -1 here. Views are the first
dimension of the inputs, so Triton must not add a batch: `max_batch_size` is 0.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import onnx

from ..runtime.errors import InputError
from ..runtime.inference.metadata import INPUTS, ModelMetadata, StageFile, expected_outputs, read_manifest
from ..runtime.system.files import atomic_write, make_folder
from .existing_exports import weights_beside
from .graph.external_data import publish
from .targets import CPU

VERSION, CONFIG, GRAPH = "1", "config.pbtxt", "model.onnx"
STAGED = "staged"  # in the working folder
ENSEMBLE = "ensemble"
PLACEHOLDER = ".keep"  # an ensemble has an empty version; object stores and git hold no empty folders
TYPES: dict[int, str] = {
    onnx.TensorProto.FLOAT: "TYPE_FP32",
    onnx.TensorProto.FLOAT16: "TYPE_FP16",
    onnx.TensorProto.INT32: "TYPE_INT32",
    onnx.TensorProto.INT64: "TYPE_INT64",
    onnx.TensorProto.BOOL: "TYPE_BOOL",
}
LATEST = -1  # version of a model


def model_name(metadata: ModelMetadata) -> str:
    """The name of the fused model, with which those of the stages begin."""
    suffix = "" if metadata.precision == "float32" else f"-{metadata.precision}"
    return f"{metadata.preset}{suffix}" + ("" if metadata.target == CPU else f"-{metadata.target}")


def repository_files(folder: Path, metadata: ModelMetadata, stages: Iterable[str]) -> list[Path]:
    """The graphs and configurations that `write_repository` writes. stages: their names."""
    name = model_name(metadata)
    files = [folder / name / VERSION / GRAPH, folder / f"{name}-{ENSEMBLE}" / CONFIG, folder / name / CONFIG]
    for stage in stages:
        own = folder / f"{name}-{stage}"
        files += [own / VERSION / f"{stage}.onnx", own / CONFIG]
    return files


def write_repository(folder: Path, working: Path, metadata: ModelMetadata) -> list[Path]:
    """Move the graphs of an export to their places in a repository, and write the configurations; the models' folders.

    working: a folder in the repository's, with the fused graph, GRAPH, and the staged folder, STAGED.
    Raises InputError if the folder cannot be written.
    """
    name, written = model_name(metadata), []
    fused = _place(folder / name, working / GRAPH)
    _write(folder / name, _graph_config(name, fused, metadata))
    written.append(folder / name)
    stages = read_manifest(working / STAGED)
    values: dict[str, onnx.ValueInfoProto] = {}
    for stage in stages:
        own = folder / f"{name}-{stage.name}"
        graph = _place(own, working / STAGED / stage.file)
        values |= {value.name: value for value in (*_graph(graph).input, *_graph(graph).output)}
        _write(own, _graph_config(own.name, graph, metadata))
        written.append(own)
    ensemble = folder / f"{name}-{ENSEMBLE}"
    with atomic_write(make_folder(ensemble / VERSION) / PLACEHOLDER) as temporary:
        temporary.touch()
    _write(ensemble, _ensemble_config(name, stages, values, metadata))
    return [*written, ensemble]


def _place(model: Path, graph: Path) -> Path:
    """Move a graph and its weights into the version of a model; its new path."""
    weights = [graph.parent / name for name in sorted(weights_beside(graph))]
    return publish([graph, *weights], make_folder(model / VERSION))[0]


def _write(model: Path, config: str) -> None:
    with atomic_write(model / CONFIG) as temporary:
        temporary.write_text(config, encoding="utf-8")


def _graph(path: Path) -> onnx.GraphProto:
    return onnx.load(path, load_external_data=False).graph


def _graph_config(name: str, path: Path, metadata: ModelMetadata) -> str:
    """The configuration of one graph. Graphs for CPUs have loops, which are slow on GPUs."""
    graph = _graph(path)
    lines = [
        f"# {metadata.conventions}",
        f"name: {_text(name)}",
        'backend: "onnxruntime"',
        f"default_model_filename: {_text(path.name)}",
        "max_batch_size: 0",
        *(_tensor("input", value) for value in graph.input),
        *(_tensor("output", value) for value in graph.output),
    ]
    if metadata.target == CPU:
        lines.append("instance_group [ { kind: KIND_CPU } ]")
    return "\n".join(lines) + "\n"


def _ensemble_config(
    name: str, stages: Sequence[StageFile], values: dict[str, onnx.ValueInfoProto], metadata: ModelMetadata
) -> str:
    """The configuration of what runs the stages. values: all tensors, by name."""
    read = {tensor for stage in stages for tensor in stage.inputs}
    lines = [
        f"# {metadata.conventions}",
        f"name: {_text(f'{name}-{ENSEMBLE}')}",
        'platform: "ensemble"',
        "max_batch_size: 0",
        *(_tensor("input", values[tensor]) for tensor in INPUTS if tensor in read),
        *(_tensor("output", values[tensor]) for tensor in expected_outputs(metadata)),
        "ensemble_scheduling {",
    ]
    for stage in stages:
        maps = [("input_map", stage.inputs), ("output_map", stage.outputs)]
        pairs = (
            f"    {field} {{ key: {_text(tensor)} value: {_text(tensor)} }}"
            for field, names in maps
            for tensor in names
        )
        step = [f"    model_name: {_text(f'{name}-{stage.name}')}", f"    model_version: {LATEST}", *pairs]
        lines += ["  step {", *step, "  }"]
    return "\n".join([*lines, "}"]) + "\n"


def _tensor(field: str, value: onnx.ValueInfoProto) -> str:
    tensor = value.type.tensor_type
    if tensor.elem_type not in TYPES or not tensor.shape.dim:
        raise InputError(f"{value.name}: Triton has no tensors of its type or shape; export without --triton")
    sizes = ", ".join(str(size.dim_value) if size.HasField("dim_value") else "-1" for size in tensor.shape.dim)
    return f"{field} {{ name: {_text(value.name)} data_type: {TYPES[tensor.elem_type]} dims: [ {sizes} ] }}"


def _text(text: str) -> str:
    """A string of Protobuf's text format, whose escapes are JSON's."""
    return json.dumps(text)
