"""Proof that a graph computes what the network does: each stage on the network's own inputs, then the whole."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import onnx
import torch

from ..runtime.bundle import OUTPUTS, Description
from ..runtime.session import open_session, run_session
from .exporter import Fixed, stage_graph
from .stages import NamedTensors, example_inputs, find_stages

# Errors are in standard deviations of the tensor. Within a stage both sides start from the same numbers; what is left
# is float32 rounding, and the few pixels where a projection falls on the border of two and rounds to the other.
STAGE_TOLERANCE = 1e-3
# End to end those few pixels change what the next stage searches, so errors grow from stage to stage: the released
# program itself, run on another processor, moves by about a hundredth of this in the median on random weights.
WHOLE_TOLERANCE = 1e-1
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


def verify(
    network: NamedTensors, traced: onnx.ModelProto, fused: bytes, description: Description, fixed: Fixed
) -> Iterator[Parity]:
    """Compare the stages of a traced graph, and the finished fused one, with the network on two shapes."""
    for views, height, width in _cases(description, fixed):
        inputs = example_inputs(views, height, width, description.near, description.far)
        with torch.no_grad():
            expected = {name: value.numpy() for name, value in network.named(*inputs.values()).items()}
        feeds = {**expected, **{name: value.numpy() for name, value in inputs.items()}}
        case = f"{views} views {height}x{width}"
        for stage in find_stages(traced):
            session = open_session(stage_graph(traced, stage, description).SerializeToString())
            found = run_session(session, feeds)
            yield from _compare(case, stage.name, stage.outputs, found, expected, STAGE_TOLERANCE)
        found = run_session(open_session(fused), feeds)
        yield from _compare(case, WHOLE, OUTPUTS, found, expected, WHOLE_TOLERANCE)


def _cases(description: Description, fixed: Fixed) -> list[tuple[int, int, int]]:
    """Two different numbers of views and sizes, as far as they are not fixed."""
    trained = (description.height, description.width)
    small = (6 * description.size_multiple, 8 * description.size_multiple)
    return [(fixed.views or 2, *(fixed.size or trained)), (fixed.views or 3, *(fixed.size or small))]


def _compare(
    case: str,
    stage: str,
    names: Iterable[str],
    found: dict[str, np.ndarray],
    expected: dict[str, np.ndarray],
    tolerance: float,
) -> Iterator[Parity]:
    for name in names:
        if found[name].shape != expected[name].shape:
            yield Parity(case, stage, name, np.inf, np.inf, tolerance)
            continue
        ours = found[name].astype(np.float64)
        if name == UP_TO_SCALE:
            ours *= _scale(ours, expected[name])
        deviation = float(expected[name].std()) or 1.0
        error = np.abs(ours - expected[name]) / deviation
        yield Parity(case, stage, name, float(error.max()), float(np.median(error)), tolerance)


def _scale(found: np.ndarray, expected: np.ndarray) -> float:
    """What brings one relative disparity to the scale of another, by the positive values that are not extreme."""
    known = (found > 0) & (expected > 0)
    if not known.any():
        return 1.0
    bulk = known & (expected <= np.percentile(expected[known], BULK))
    return float(expected[bulk].sum() / found[bulk].sum()) if bulk.any() else 1.0
