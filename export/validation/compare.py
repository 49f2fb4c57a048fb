"""Comparison of exported graphs with the network in PyTorch: each stage by itself, then end to end.

Errors are in standard deviations of each channel, so that a strong channel does not hide a weak one. Three quantiles of
a tensor's errors are bounded:

- the median of the worst channel in the worst view, which a wrong view, channel or axis changes,
- the 99th and the 99.9th percentile of the worst view, which a wrong border or corner changes.

The largest error is not bounded. IDESplat's warp takes the nearest pixel: where a projection falls within rounding of
the border between two pixels, the graph may take the other one. Its focused module keeps the strongest neighbours, and
may choose otherwise between equals. Both change single pixels by any amount, and where a U-Net attends from pixel to
pixel, all others a little. So a bound is at least OWN_ERRORS times what the network's own result changes by where its
cameras are rounded up, and never more than the bound end to end.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...model.family import MIN_DEVIATION, ErrorQuantiles, Tolerance
from ...runtime.inference.metadata import INPUTS, OUTPUTS, ModelMetadata
from ...runtime.inference.session import open_session, run_session
from ..stages import NamedTensors, Stage
from ..tracing import StaticShape
from .cases import Case, verification_cases

ENCODER = "encoder"  # the stage that does not warp
FUSED, STAGED = "fused, end to end", "staged, end to end"
# The scales of scale-free tensors are matched below this percentile, where no value is extreme.
BULK = 90
# The graph rounds at every step, and the cameras of a case are rounded once.
OWN_ERRORS = 4
QUANTILE_NAMES = ("median", "99 %", "99.9 %")


@dataclass(frozen=True)
class TensorError:
    """Errors of one tensor of a graph against the network's, and their bounds."""

    case: str
    stage: str
    tensor: str
    errors: ErrorQuantiles
    bounds: ErrorQuantiles
    largest: float

    @property
    def passed(self) -> bool:
        """Whether every quantile is within its bound; NaN is not."""
        return all(error <= bound for error, bound in zip(self.errors, self.bounds, strict=True))

    @property
    def ratios(self) -> list[float]:
        """Each quantile over its bound."""
        ratios = (error / bound for error, bound in zip(self.errors, self.bounds, strict=True))
        return [np.inf if np.isnan(ratio) else ratio for ratio in ratios]


@dataclass(frozen=True)
class Exported:
    """Graph files to verify.

    stages: each stage with its graph. staged: whether these are written for the user, and so are also run in a row.
    fused: the whole network's graph, if it is written.
    """

    stages: list[tuple[Stage, Path]]
    staged: bool = True
    fused: Path | None = None


def verify(
    network: NamedTensors, exported: Exported, metadata: ModelMetadata, static: StaticShape
) -> Iterator[TensorError]:
    """Compare the graph of every stage with the network, and what is written for the user end to end."""
    cases = list(verification_cases(network, metadata, static))
    yield from compare(exported, cases, network.family.tolerances[metadata.precision])


def compare(exported: Exported, cases: list[Case], tolerance: Tolerance) -> Iterator[TensorError]:
    """Compare graphs with what the network computed for some cases."""
    chained = [{name: case.tensors[name] for name in INPUTS} for case in cases]  # tensors of the staged graphs in a row
    for stage, path in exported.stages:
        session = open_session(path)
        for case, values in zip(cases, chained, strict=True):
            found = run_session(session, case.tensors)
            bounds = tolerance.encoder if stage.name == ENCODER else tolerance.stage
            yield from _tensor_errors(stage.name, stage.outputs, found, case, bounds, tolerance)
            if exported.staged:
                values |= run_session(session, values)
    if exported.staged:
        for case, values in zip(cases, chained, strict=True):
            yield from _tensor_errors(STAGED, _outputs(case), values, case, tolerance.end_to_end, tolerance)
    if exported.fused is not None:
        session = open_session(exported.fused)
        for case in cases:
            found = run_session(session, case.tensors)
            yield from _tensor_errors(FUSED, _outputs(case), found, case, tolerance.end_to_end, tolerance)


def _outputs(case: Case) -> list[str]:
    return [name for name in OUTPUTS if name in case.tensors]


def _tensor_errors(
    stage: str,
    names: Iterable[str],
    found: dict[str, np.ndarray],
    case: Case,
    bounds: ErrorQuantiles,
    tolerance: Tolerance,
) -> Iterator[TensorError]:
    for name in names:
        errors, largest = _errors_of(name, found[name], case, tolerance)
        yield TensorError(case.name, stage, name, errors, _own_bounds(name, case, bounds, tolerance), largest)


def _errors_of(name: str, values: np.ndarray, case: Case, tolerance: Tolerance) -> tuple[ErrorQuantiles, float]:
    """The quantiles of a tensor's errors against the case's, and the largest, without the scale of scale-free ones."""
    expected = case.tensors[name]
    with np.errstate(all="ignore"):  # NaN and infinity are outside every bound
        if name in tolerance.scale_free and values.shape == expected.shape:
            values = values * _relative_scale(values, expected)
        return error_quantiles(values, expected, case.views, tolerance.min_deviation)


def _own_bounds(name: str, case: Case, bounds: ErrorQuantiles, tolerance: Tolerance) -> ErrorQuantiles:
    """The bounds of a tensor, raised where the network itself turns rounding into larger errors."""
    own, _ = _errors_of(name, case.rounded[name], case, tolerance)
    limits = zip(bounds, own, tolerance.end_to_end, strict=True)
    return ErrorQuantiles(*(max(bound, min(OWN_ERRORS * error, most)) for bound, error, most in limits))


def error_quantiles(
    found: np.ndarray, expected: np.ndarray, views: int, min_deviation: float = MIN_DEVIATION
) -> tuple[ErrorQuantiles, float]:
    """The quantiles of one tensor's errors in standard deviations of each channel, and its largest error.

    Infinite where shapes, or integers, differ. min_deviation: as in `Tolerance`.
    """
    if found.shape != expected.shape:
        return ErrorQuantiles(np.inf, np.inf, np.inf), np.inf
    if np.issubdtype(expected.dtype, np.integer):
        largest = 0.0 if np.array_equal(found, expected) else np.inf
        return ErrorQuantiles(largest, largest, largest), largest
    found, expected = (_by_channel(values.astype(np.float64), views) for values in (found, expected))
    deviation = np.maximum(expected.std((0, 2)), min_deviation * np.sqrt(np.square(expected).mean()))
    error = np.abs(found - expected) / np.where(deviation > 0, deviation, 1)[:, None]
    per_view = np.percentile(error.reshape(views, -1), (99, 99.9), axis=1).max(1)
    return ErrorQuantiles(float(np.median(error, 2).max()), *map(float, per_view)), float(error.max())


def _by_channel(values: np.ndarray, views: int) -> np.ndarray:
    """Maps [views, channels, h, w], depth [views, h, w], Gaussians [views * pixels, ...] by view, channel and pixel."""
    if len(values) != views:
        return np.moveaxis(values.reshape(views, len(values) // views, -1), 1, 2)
    channels = values.shape[1] if values.ndim == 4 else 1
    return values.reshape(views, channels, -1)


def _relative_scale(found: np.ndarray, expected: np.ndarray) -> float:
    """The factor that brings one scale-free tensor to the scale of another, from positive values below `BULK`."""
    known = (found > 0) & (expected > 0)
    if not known.any():
        return 1.0
    bulk = known & (expected <= np.percentile(expected[known], BULK))
    return float(expected[bulk].sum() / found[bulk].sum()) if bulk.any() else 1.0
