"""Weights in a file beside a graph, so that graphs are cut, checked and run without a copy of the weights in memory."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import onnx
from onnx.external_data_helper import ExternalDataInfo
from torch import Tensor

from ..runtime.files import replacing

# Protobuf reads no message of 2 GiB or more, so a larger model keeps its weights beside it when it is handed out, too.
LARGEST_FILE = 2_000_000_000
BESIDE = ".data"


def fill_inputs(model: onnx.ModelProto, weights: Iterable[tuple[str, Tensor]], path: Path) -> None:
    """Make initialisers of the graph's inputs that weights are named after, their values in a new file at `path`."""
    inputs = {value.name: value for value in model.graph.input}
    with path.open("wb") as file:
        for name, weight in weights:
            if name in inputs:
                values = weight.detach().numpy()
                element = onnx.helper.np_dtype_to_tensor_dtype(values.dtype)
                tensor = model.graph.initializer.add(name=name, dims=values.shape, data_type=element)
                _refer(tensor, path.name, file.tell(), values.nbytes)
                values.tofile(file)
                model.graph.input.remove(inputs[name])


def hand_out(graph: Path, out: Path) -> list[Path]:
    """Write a graph whose weights lie beside it to `out`, which then holds them unless that makes it too large.

    Returns the paths written, each whole or not at all; what cannot stay together is `out` and a file that is to be
    moved along with it.
    """
    model = onnx.load(graph, load_external_data=False)
    size = model.ByteSize() + sum(ExternalDataInfo(tensor).length or 0 for tensor in _outside(model))
    if size <= LARGEST_FILE:
        for tensor in _outside(model):
            tensor.raw_data = _values(tensor, graph.parent)
            tensor.ClearField("external_data")
            tensor.ClearField("data_location")
        with replacing(out) as temporary:
            temporary.write_bytes(model.SerializeToString())
        return [out]
    beside = out.with_name(out.name + BESIDE)
    with replacing(out) as temporary, replacing(beside) as weights:  # the last comes first into its place
        with weights.open("wb") as file:
            for tensor in _outside(model):
                values = _values(tensor, graph.parent)
                _refer(tensor, beside.name, file.tell(), len(values))
                file.write(values)
        temporary.write_bytes(model.SerializeToString())
    return [out, beside]


def _outside(model: onnx.ModelProto) -> Iterator[onnx.TensorProto]:
    return (tensor for tensor in model.graph.initializer if tensor.data_location == onnx.TensorProto.EXTERNAL)


def _values(tensor: onnx.TensorProto, folder: Path) -> bytes:
    place = ExternalDataInfo(tensor)
    with (folder / place.location).open("rb") as file:
        file.seek(place.offset or 0)
        return file.read(place.length)


def _refer(tensor: onnx.TensorProto, location: str, offset: int, length: int) -> None:
    """Say that a tensor's values are in another file, which is found in the graph's own folder wherever that is."""
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.ClearField("external_data")
    for key, value in (("location", location), ("offset", offset), ("length", length)):
        tensor.external_data.add(key=key, value=str(value))
