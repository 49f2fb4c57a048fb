"""Checks of a graph against its metadata and manifest: of its signature before it runs, of its results afterwards."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from ..errors import InputError
from .metadata import INPUTS, ModelMetadata, expected_outputs
from .metadata_fields import shown

FLOAT = "tensor(float)"


class Value(Protocol):
    """An input or output as ONNX Runtime describes it; strings and None are dynamic dimensions."""

    name: str
    type: str
    shape: Sequence[int | str | None]


class Graph(Protocol):
    """The part of an ONNX Runtime session that is checked."""

    def get_inputs(self) -> Sequence[Value]:
        """The inputs."""

    def get_outputs(self) -> Sequence[Value]:
        """The outputs."""


def check_fused(path: Path, graph: Graph, own: ModelMetadata) -> None:
    """Raise InputError unless the single graph has the network's inputs and the outputs that the metadata states."""
    inputs, outputs = ({value.name: value for value in part} for part in (graph.get_inputs(), graph.get_outputs()))
    unknown = [name for name in inputs if name not in INPUTS]
    if unknown:
        raise _mismatch(path, f"it reads {shown(unknown[0])}, expected {', '.join(INPUTS)}")
    missing = [name for name in expected_outputs(own) if name not in outputs]
    if missing:
        raise _mismatch(path, f"it does not yield {missing[0]}")
    _check_values(path, inputs, outputs, own)


def check_stage(
    path: Path, graph: Graph, reads: Sequence[str], yields: Sequence[str], own: ModelMetadata, known: dict[str, str]
) -> None:
    """Raise InputError unless a stage's graph has the inputs and outputs of the manifest.

    known: the types of the outputs of earlier stages, by name; those of this stage are added.
    """
    inputs, outputs = ({value.name: value for value in part} for part in (graph.get_inputs(), graph.get_outputs()))
    for found, expected, does in ((inputs, reads, "reads"), (outputs, yields, "yields")):
        for name in sorted(set(found) ^ set(expected)):
            who, other = ("graph", "manifest") if name in found else ("manifest", "graph")
            raise _mismatch(path, f"by the {who} it {does} {shown(name)}, by the {other} it does not")
    for name, value in inputs.items():
        if known.get(name, value.type) != value.type:
            raise _mismatch(path, f"{shown(name)} is a {value.type}, an earlier stage yields a {known[name]}")
    known |= {name: value.type for name, value in outputs.items()}
    _check_values(path, inputs, outputs, own)


def check_results(values: Mapping[str, object], views: int, height: int, width: int, own: ModelMetadata) -> None:
    """Raise InputError unless the results have the shapes and ranges that `Prediction` documents."""
    count, coefficients = views * height * width, (own.sh_degree + 1) ** 2
    shapes: dict[str, tuple[int, ...]] = {
        "depth": (views, height, width),
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "opacities": (count,),
        "sh": (count, coefficients, 3),
    }
    for name in expected_outputs(own):
        value = values[name]
        if not isinstance(value, np.ndarray) or value.dtype != np.float32 or value.shape != shapes[name]:
            found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise InputError(f"the graph yields {name} as {found}, expected float32 {shapes[name]}; export it again")
        finite = np.isfinite(value)
        if not finite.all():
            share = 100 * (1 - finite.mean())
            raise InputError(
                f"the graph yields NaN or infinity in {share:.3g} % of {name}: its weights are damaged, or its "
                f"precision ({shown(own.precision)}) is too low for it; export it again in float32"
            )
    _check_signs(values, own)


def _check_signs(values: Mapping[str, object], own: ModelMetadata) -> None:
    """Raise InputError unless depth is positive, scales at least 0 and opacities within 0 and 1."""
    ranges = {"depth": (np.nextafter(np.float32(0), 1), np.inf), "scales": (0, np.inf), "opacities": (0, 1)}
    for name, (low, high) in ranges.items():
        value = values[name] if name in expected_outputs(own) else None
        if isinstance(value, np.ndarray) and not (value.min() >= low and value.max() <= high):
            raise InputError(
                f"the graph yields {name} from {value.min():g} to {value.max():g}, expected "
                f"{'0 to 1' if high == 1 else 'positive numbers'}; export it again"
            )


def _check_values(path: Path, inputs: Mapping[str, Value], outputs: Mapping[str, Value], own: ModelMetadata) -> None:
    """Check types and shapes of the network's inputs and outputs; tensors between stages may have any."""
    views = own.fixed_views or None
    height, width = (own.height, own.width) if own.fixed_size else (None, None)
    count = views * height * width if views and height and width else None
    shapes: dict[str, tuple[int | None, ...]] = {
        "images": (views, 3, height, width),
        "extrinsics": (views, 4, 4),
        "intrinsics": (views, 3, 3),
        "near": (views,),
        "far": (views,),
        "depth": (views, height, width),
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "opacities": (count,),
        "sh": (count, (own.sh_degree + 1) ** 2, 3),
    }
    for values, reads in ((inputs, True), (outputs, False)):
        for name, value in values.items():
            if name in shapes and value.type != FLOAT:
                raise _mismatch(path, f"{name} is a {value.type}, expected {FLOAT}")
            if name in shapes and not _fits(value.shape, shapes[name], exactly=reads):
                raise _mismatch(path, f"{name} has the shape {_words(value.shape)}, expected {_words(shapes[name])}")


def _fits(found: Sequence[int | str | None], expected: Sequence[int | None], exactly: bool) -> bool:
    """Whether a declared shape agrees with the expected one.

    exactly: dynamic dimensions must be dynamic in the graph, too; for outputs, the optimiser may infer their size.
    """
    if not found and not exactly:  # ONNX Runtime's shape of an output of unknown rank
        return True
    sizes = [size if isinstance(size, int) else None for size in found]
    if exactly:
        return sizes == list(expected)
    return len(sizes) == len(expected) and all(None in (a, b) or a == b for a, b in zip(sizes, expected, strict=True))


def _words(shape: Sequence[int | str | None]) -> str:
    return "[" + ", ".join("any" if size is None else str(size)[:40] for size in shape) + "]"


def _mismatch(path: Path, what: str) -> InputError:
    return InputError(f"{path}: the graph is not what its metadata says: {what}; export it again")
