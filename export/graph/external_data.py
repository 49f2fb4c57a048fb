"""Graphs with external weights: split, checked and run without a copy of the weights in memory."""

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import onnx
from onnx.external_data_helper import ExternalDataInfo
from torch import Tensor

from ...runtime.errors import InputError
from ..existing_exports import is_our_graph, weights_beside

# Protobuf reads no message of 2 GiB or more, so the weights of a larger model are written to a file of their own.
LARGEST_FILE = 2_000_000_000
BESIDE = ".data"
DIGITS = 16  # of its SHA-256 in the name of a file of weights


def fill_inputs(model: onnx.ModelProto, weights: Iterable[tuple[str, Tensor]], path: Path) -> None:
    """Turn the graph's inputs of these names into initialisers, with the values in a new file at `path`."""
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


def save_model(graph: Path, out: Path, external: bool = False) -> list[Path]:
    """Write a graph with external weights to a new file that holds the weights, too, unless that makes it too large.

    external: keep the weights in a file of their own whatever their size.

    Returns the paths written: `out` and, unless they are in it, the file of its weights, which is named after its
    content and must stay in the same folder.
    """
    model = onnx.load(graph, load_external_data=False)
    size = model.ByteSize() + sum(ExternalDataInfo(tensor).length or 0 for tensor in _outside(model))
    if size <= LARGEST_FILE and not external:
        for tensor in _outside(model):
            tensor.raw_data = _values(tensor, graph.parent)
            tensor.ClearField("external_data")
            tensor.ClearField("data_location")
        out.write_bytes(model.SerializeToString())
        return [out]
    beside, digest = out.with_name(out.name + BESIDE), hashlib.sha256()
    places = []
    with beside.open("wb") as file:
        for tensor in _outside(model):
            values = _values(tensor, graph.parent)
            places.append((file.tell(), len(values)))
            file.write(values)
            digest.update(values)
    beside = beside.rename(out.with_name(_name_beside(out.name, digest.hexdigest())))
    for tensor, (offset, length) in zip([*_outside(model)], places, strict=True):
        _refer(tensor, beside.name, offset, length)
    out.write_bytes(model.SerializeToString())
    return [out, beside]


def check_weights(graph: Path, written: Path) -> None:
    """Raise InputError unless a graph that `save_model` wrote holds the same weights as its source.

    Outputs alone would not show a damaged weight that has little effect in the verification cases.
    """
    found, expected = (
        {
            tensor.name: _digest(tensor, path.parent)
            for tensor in onnx.load(path, load_external_data=False).graph.initializer
        }
        for path in (written, graph)
    )
    wrong = sorted(name for name in expected if found.get(name) != expected[name])
    if wrong or len(found) != len(expected):
        raise InputError(f"{written.name}: its weights were not written as they are ({wrong[:1]}); is the disk sound?")


def _digest(tensor: onnx.TensorProto, folder: Path) -> bytes:
    outside = tensor.data_location == onnx.TensorProto.EXTERNAL
    values = _values(tensor, folder) if outside else onnx.numpy_helper.to_array(tensor).tobytes()
    return hashlib.sha256(values).digest()


def publish(files: list[Path], folder: Path) -> list[Path]:
    """Move the files of `save_model` into a folder of the same file system, over a graph of that name; their paths.

    If the run is killed meanwhile, the old graph with its weights remains, or the new one with its own: new weights
    are moved first, under a name of their own, and the weights of the replaced graph are removed last.
    Raises InputError if the folder cannot be written.
    """
    graph = folder / files[0].name
    old = weights_beside(graph) if is_our_graph(graph) else set()
    try:
        moved = [file.replace(folder / file.name) for file in reversed(files)][::-1]
        old |= {path.name for path in folder.iterdir() if _is_of(path, graph.name)}
        old -= {path.name for path in moved}
        if old:  # unless a copy of the old graph still reads them
            old = old.difference(*(weights_beside(other) for other in folder.glob("*.onnx")))
        for name in old:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {graph}: {error.strerror}; choose another folder") from None
    return moved


def _name_beside(graph: str, digest: str) -> str:
    """The name of a file with the weights of a graph."""
    return f"{graph}.{digest[:DIGITS]}{BESIDE}"


def _is_of(path: Path, graph: str) -> bool:
    """Whether a file holds weights that a run wrote for a graph of this name: its name has the hash of its content."""
    if not (path.name.startswith(f"{graph}.") and path.name.endswith(BESIDE) and path.is_file()):
        return False
    if len(path.name) != len(_name_beside(graph, "0" * DIGITS)):
        return False
    with path.open("rb") as file:
        return path.name == _name_beside(graph, hashlib.file_digest(file, "sha256").hexdigest())


def _outside(model: onnx.ModelProto) -> Iterator[onnx.TensorProto]:
    return (tensor for tensor in model.graph.initializer if tensor.data_location == onnx.TensorProto.EXTERNAL)


def _values(tensor: onnx.TensorProto, folder: Path) -> bytes:
    place = ExternalDataInfo(tensor)
    with (folder / place.location).open("rb") as file:
        file.seek(place.offset or 0)
        return file.read(place.length)


def _refer(tensor: onnx.TensorProto, location: str, offset: int, length: int) -> None:
    """Refer a tensor's values to another file, relative to the graph's folder."""
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.ClearField("external_data")
    for key, value in (("location", location), ("offset", offset), ("length", length)):
        tensor.external_data.add(key=key, value=str(value))
