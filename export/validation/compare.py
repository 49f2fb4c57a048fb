"""Proof that the files to be handed out compute what the network does: each stage on its own, then all of them.

Errors are in standard deviations of each channel, so that no channel hides behind a stronger one. Three figures of a
tensor are compared with bounds:

- the median of its worst channel in its worst view, which a wrong view, channel or axis moves,
- the 99th and the 99.9th percentile of its worst view, which a wrong border or corner moves.

The largest error is not bounded. IDESplat's warp takes the nearest pixel, and where a projection falls within rounding
of the border between two, the graph may take the other one; its focused module keeps the strongest neighbours, and may
choose otherwise between equals. Both move single pixels by any amount.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...model.idesplat.network import IDESplat
from ...runtime.inference.metadata import INPUTS, OUTPUTS, ModelMetadata
from ...runtime.inference.session import open_session, run_session
from ..precision.convert import FLOAT32
from ..stages import NamedTensors, Stage
from ..tracing import StaticShape
from .cases import Case, verification_cases

ENCODER = "encoder"  # the stage that does not warp
FUSED, STAGED = "fused, end to end", "staged, end to end"
# Relative disparity is divided by its largest value, the inverse of the smallest number that a ReLU lets through: its
# scale is rounding, its shape is not. Below this percentile, at which the scales are matched, no value is extreme.
UP_TO_SCALE = "encoder.mono_disparity"
BULK = 90
# A channel's standard deviation counts for at least this share of its tensor's root mean square: float32 rounds sums of
# the tensor's magnitude, whose error (6e-8 of it, times the square root of some thousand terms) is then below 1e-2.
SMALLEST_DEVIATION = 1e-3
# int8 has 256 numbers for the range of a whole tensor, some 20 root mean squares where a transformer has outliers. Each
# rounding is off by 0.02 of one, a dozen in a row by a tenth, whatever the deviation of the channel is.
SMALLEST_DEVIATION_INT8 = 0.25


class Figures(NamedTuple):
    """Of the errors of one tensor, or their bounds."""

    median: float
    percentile_99: float
    percentile_99_9: float


FIGURE_NAMES = ("median", "99 %", "99.9 %")


@dataclass(frozen=True)
class Tolerance:
    """Bounds for the encoder and the other stages, which start from the network's own tensors, and for all in a row.

    smallest_deviation: what a channel's standard deviation counts for at least, in root mean squares of its tensor.
    """

    encoder: Figures
    stage: Figures
    whole: Figures
    smallest_deviation: float = SMALLEST_DEVIATION


# Where each bound comes from: docs/parity.md. IDESplat's relative disparity, the inverse of numbers of which some are
# almost nothing, has a bound of its encoder's own at its extremes.
SMOOTH = Figures(1e-4, 1e-3, 2e-3)
BILINEAR = Tolerance(SMOOTH, SMOOTH, Figures(1e-3, 1e-2, 5e-2))
NEAREST = Tolerance(Figures(1e-4, 1e-3, 2e-1), Figures(5e-3, 1e-1, 3e-1), Figures(5e-2, 5e-1, 1.0))
LOWER = {
    "fp16": Tolerance(Figures(2e-2, 2e-1, 1.0), Figures(2e-2, 2e-1, 1.0), Figures(1e-1, 5e-1, 1.0)),
    "int8": Tolerance(
        Figures(5e-1, 2.0, 4.0), Figures(5e-1, 2.0, 4.0), Figures(5e-1, 2.0, 4.0), SMALLEST_DEVIATION_INT8
    ),
}


@dataclass(frozen=True)
class TensorError:
    """How far one tensor of a graph is from the network's."""

    case: str
    stage: str
    tensor: str
    errors: Figures
    bounds: Figures
    largest: float

    @property
    def passed(self) -> bool:
        """Whether every figure is within its bound; NaN is not."""
        return all(error <= bound for error, bound in zip(self.errors, self.bounds, strict=True))

    @property
    def shares(self) -> list[float]:
        """Each figure over its bound."""
        shares = (error / bound for error, bound in zip(self.errors, self.bounds, strict=True))
        return [np.inf if np.isnan(share) else share for share in shares]


@dataclass(frozen=True)
class Exported:
    """Files to verify.

    stages: with the graph of each. staged: whether they are to be handed out, and so must compute the whole in a row.
    fused: the graph of the whole that is to be handed out, if it is.
    """

    stages: list[tuple[Stage, Path]]
    staged: bool = True
    fused: Path | None = None


def verify(
    network: NamedTensors, exported: Exported, description: ModelMetadata, static: StaticShape
) -> Iterator[TensorError]:
    """Compare the graph of every stage with the network, and everything that is handed out, end to end."""
    cases = list(verification_cases(network, description, static))
    yield from compare(exported, cases, tolerance_for(network, description.precision))


def compare(exported: Exported, cases: list[Case], tolerance: Tolerance) -> Iterator[TensorError]:
    """Compare graphs with what the network computed for some cases."""
    rows = [{name: case.tensors[name] for name in INPUTS} for case in cases]
    smallest = tolerance.smallest_deviation
    for stage, path in exported.stages:
        session = open_session(path)
        for case, values in zip(cases, rows, strict=True):
            found = run_session(session, case.tensors)
            bounds = tolerance.encoder if stage.name == ENCODER else tolerance.stage
            yield from _errors(stage.name, stage.outputs, found, case, bounds, smallest)
            if exported.staged:
                values |= run_session(session, values)
    if exported.staged:
        for case, values in zip(cases, rows, strict=True):
            yield from _errors(STAGED, _results(case), values, case, tolerance.whole, smallest)
    if exported.fused is not None:
        session = open_session(exported.fused)
        for case in cases:
            found = run_session(session, case.tensors)
            yield from _errors(FUSED, _results(case), found, case, tolerance.whole, smallest)


def tolerance_for(network: NamedTensors, precision: str) -> Tolerance:
    """The bounds for a network in a precision."""
    if precision == FLOAT32:
        return NEAREST if isinstance(network.model, IDESplat) else BILINEAR
    return LOWER[precision]


def _results(case: Case) -> list[str]:
    return [name for name in OUTPUTS if name in case.tensors]


def _errors(
    stage: str, names: Iterable[str], found: dict[str, np.ndarray], case: Case, bounds: Figures, smallest: float
) -> Iterator[TensorError]:
    for name in names:
        with np.errstate(all="ignore"):  # NaN and infinity are no figure within a bound
            figures, largest = _figures(name, found[name], case.tensors[name], case.views, smallest)
        yield TensorError(case.name, stage, name, figures, bounds, largest)


def _figures(
    name: str, found: np.ndarray, expected: np.ndarray, views: int, smallest: float = SMALLEST_DEVIATION
) -> tuple[Figures, float]:
    """The figures of one tensor and its largest error."""
    if found.shape != expected.shape:
        return Figures(np.inf, np.inf, np.inf), np.inf
    if np.issubdtype(expected.dtype, np.integer):
        largest = 0.0 if np.array_equal(found, expected) else np.inf
        return Figures(largest, largest, largest), largest
    if name == UP_TO_SCALE:
        found = found * _scale(found, expected)
    found, expected = (_by_channel(values.astype(np.float64), views) for values in (found, expected))
    deviation = np.maximum(expected.std((0, 2)), smallest * np.sqrt(np.square(expected).mean()))
    error = np.abs(found - expected) / np.where(deviation > 0, deviation, 1)[:, None]
    per_view = np.percentile(error.reshape(views, -1), (99, 99.9), axis=1).max(1)
    return Figures(float(np.median(error, 2).max()), *map(float, per_view)), float(error.max())


def _by_channel(values: np.ndarray, views: int) -> np.ndarray:
    """Maps [views, channels, h, w], depth [views, h, w], Gaussians [views * pixels, ...] by view, channel and place."""
    if len(values) != views:
        return np.moveaxis(values.reshape(views, len(values) // views, -1), 1, 2)
    channels = values.shape[1] if values.ndim == 4 else 1
    return values.reshape(views, channels, -1)


def _scale(found: np.ndarray, expected: np.ndarray) -> float:
    """What brings one relative disparity to the scale of another, by the positive values that are not extreme."""
    known = (found > 0) & (expected > 0)
    if not known.any():
        return 1.0
    bulk = known & (expected <= np.percentile(expected[known], BULK))
    return float(expected[bulk].sum() / found[bulk].sum()) if bulk.any() else 1.0
