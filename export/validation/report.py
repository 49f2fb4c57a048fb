"""Tables of the verification: one line a stage, or every tensor of every case."""

import sys
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from .compare import QUANTILE_NAMES, TensorError

TITLE = "ONNX Runtime against PyTorch: errors in standard deviations of each channel"
LEGEND = (
    "median: of the worst channel of the worst view; 99 % and 99.9 %: percentiles of the worst view. "
    "A stage passes if each is within its bound; the table shows the one closest to its bound."
)
SUMMARY_WIDTH, DETAILS_WIDTH = 120, 170  # where it is not a terminal's


def print_summary(errors: Sequence[TensorError]) -> None:
    """Print one line a stage: the tensor and the quantile that are closest to their bound, or furthest beyond it."""
    table = Table(title=TITLE, caption=LEGEND)
    for column in ("stage", "tensors", "worst tensor", "case", "figure"):
        table.add_column(column)
    for column in ("error", "bound"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for stage in dict.fromkeys(error.stage for error in errors):
        rows = [error for error in errors if error.stage == stage]
        worst = max(rows, key=lambda row: max(row.ratios))
        figure = int(np.argmax(worst.ratios))
        checked = str(len({row.tensor for row in rows}))
        numbers = (f"{values[figure]:.1e}" for values in (worst.errors, worst.bounds))
        name = worst.tensor.removeprefix(f"{stage}.")
        table.add_row(stage, checked, name, worst.case, QUANTILE_NAMES[figure], *numbers, _verdict(worst))
    _console(SUMMARY_WIDTH).print(table)


def print_details(errors: Sequence[TensorError]) -> None:
    """Print every tensor of every case, with each quantile and its bound, and the largest error, which has none."""
    table = Table(title=TITLE)
    for column in ("case", "stage", "tensor"):
        table.add_column(column)
    for column in (*(f"{name} / bound" for name in QUANTILE_NAMES), "largest"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for row in errors:
        figures = (f"{error:.1e} / {bound:.0e}" for error, bound in zip(row.errors, row.bounds, strict=True))
        table.add_row(row.case, row.stage, row.tensor, *figures, f"{row.largest:.1e}", _verdict(row))
    _console(DETAILS_WIDTH).print(table)


def _verdict(error: TensorError) -> str:
    return "ok" if error.passed else "MISMATCH"


def _console(width: int) -> Console:
    return Console(width=None if sys.stdout.isatty() else width)
