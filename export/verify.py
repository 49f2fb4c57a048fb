"""Proof that a graph computes what the network does: each stage on the network's own inputs, then the whole."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..runtime.bundle import OUTPUTS, Description
from ..runtime.session import open_session, run_session
from .exporter import Fixed, Graphs
from .stages import NamedTensors, example_inputs

# Errors are in standard deviations of the tensor. Within a stage both sides start from the same numbers; what is left
# is float32 rounding, and the few pixels where a projection falls on the border of two and rounds to the other.
STAGE_TOLERANCE = {
    "float32": 1e-3,
    # Numbers of eleven bits, a few of them in a row.
    "fp16": 1e-2,
    # A hundred roundings in a row, each to one of 256 numbers over some eight standard deviations and so off by a
    # hundredth of one, make a tenth. More than twice that is a fault.
    "int8": 2e-1,
}
# End to end those few pixels change what the next stage searches, so errors grow from stage to stage: the released
# program itself, run on another processor, moves by about a hundredth of this in the median on random weights.
WHOLE_TOLERANCE = {"float32": 1e-1, "fp16": 1e-1, "int8": 2e-1}
WHOLE = "end to end"
# Relative disparity is divided by its largest value, the inverse of the smallest number that a ReLU lets through: its
# scale is rounding, its shape is not. Below this percentile, at which the scales are matched, no value is extreme.
UP_TO_SCALE = "encoder.mono_disparity"
BULK = 90


@dataclass(frozen=True)
class Parity:
    """How far one tensor of the graph is from the network's, in standard deviations of the latter."""

    case: str
    stage: str
    tensor: str
    largest: float
    median: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the median is within tolerance; NaN is not."""
        return self.median <= self.tolerance


@dataclass(frozen=True)
class Case:
    """What the network makes of some views: its inputs and all that its stages yield, by name."""

    name: str
    tensors: dict[str, np.ndarray]


def verify(network: NamedTensors, graphs: Graphs, description: Description, fixed: Fixed) -> Iterator[Parity]:
    """Compare the graphs of every stage, and that of the whole, with the network on two shapes."""
    cases = [_case(network, description, *shape) for shape in _shapes(description, fixed)]
    yield from stage_errors(graphs, cases, description.precision)
    results = [name for name in OUTPUTS if name in cases[0].tensors]
    yield from _verify(graphs.whole, WHOLE, results, cases, WHOLE_TOLERANCE[description.precision])


def stage_errors(graphs: Graphs, cases: list[Case], precision: str) -> Iterator[Parity]:
    """Compare the graph of every stage with the network, from whose tensors each of them starts."""
    for stage in graphs.stages:
        yield from _verify(graphs.of_stage(stage), stage.name, stage.outputs, cases, STAGE_TOLERANCE[precision])


def _shapes(description: Description, fixed: Fixed) -> list[tuple[int, int, int]]:
    """Two different numbers of views and sizes, as far as they are not fixed."""
    trained = (description.height, description.width)
    small = (6 * description.size_multiple, 8 * description.size_multiple)
    return [(fixed.views or 2, *(fixed.size or trained)), (fixed.views or 3, *(fixed.size or small))]


def _case(network: NamedTensors, description: Description, views: int, height: int, width: int) -> Case:
    inputs = example_inputs(views, height, width, description.near, description.far)
    with torch.no_grad():
        tensors = {**inputs, **network.named(*inputs.values())}
    return Case(f"{views} views {height}x{width}", {name: value.numpy() for name, value in tensors.items()})


def _verify(graph: Path, stage: str, names: Iterable[str], cases: list[Case], tolerance: float) -> Iterator[Parity]:
    """Run one graph on the network's own tensors and compare what it yields under these names."""
    session = open_session(graph)
    for case in cases:
        found = run_session(session, case.tensors)
        for name in names:
            largest, median = _errors(name, found[name], case.tensors[name])
            yield Parity(case.name, stage, name, largest, median, tolerance)


def _errors(name: str, found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """The largest and the median error, in standard deviations of what is expected."""
    if found.shape != expected.shape:
        return np.inf, np.inf
    found = found.astype(np.float64)
    if name == UP_TO_SCALE:
        found *= _scale(found, expected)
    error = np.abs(found - expected) / (float(expected.std()) or 1.0)
    return float(error.max()), float(np.median(error))


def _scale(found: np.ndarray, expected: np.ndarray) -> float:
    """What brings one relative disparity to the scale of another, by the positive values that are not extreme."""
    known = (found > 0) & (expected > 0)
    if not known.any():
        return 1.0
    bulk = known & (expected <= np.percentile(expected[known], BULK))
    return float(expected[bulk].sum() / found[bulk].sum()) if bulk.any() else 1.0
