"""Reports of an evaluation on captures: tables on the terminal, and results.json."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from ....runtime.cli.terminal import say
from ..metrics import LITE0, LPIPS
from ..novel_views import MODEL, NEAREST, ORACLE_PLANE, Scores
from ..report import describe, print_table, write_json
from .capture import PAIR
from .scores import INTERPOLATED, OWN_EXPOSURE, PAIRS, CaptureScores, mean_of_captures

if TYPE_CHECKING:
    from ..evaluate import CaptureEvaluation

Column = tuple[str, str, str]  # heading, method and metric
# Of the means; those that were not measured are left out.
COLUMNS: tuple[Column, ...] = (
    ("PSNR", MODEL, "psnr"),
    ("exposure\ninterpolated", MODEL, INTERPOLATED),
    ("fitted", MODEL, "psnr_fitted"),
    ("SSIM", MODEL, "ssim"),
    ("LPIPS", MODEL, LPIPS),
    ("perceptual\n(Lite0)", MODEL, LITE0),
    ("nearest", NEAREST, "psnr"),
    ("oracle\nplane", ORACLE_PLANE, "psnr"),
    ("oracle plane,\nfitted", ORACLE_PLANE, "psnr_fitted"),
    ("from the\ntwo around", PAIRS, "psnr"),
    ("exposure\ninterpolated", PAIRS, INTERPOLATED),
    ("input\nviews", MODEL, "input_psnr"),
    ("own\nexposure", MODEL, OWN_EXPOSURE),
)
DECIMALS = {"ssim": 3, LPIPS: 3, LITE0: 3}


def print_captures(results: Sequence[CaptureScores], counts: Sequence[int], size: str) -> None:
    """A row for each capture and number of views, then the means over captures."""
    rows = [(result.name, count, result.mean(count)) for result in results for count in counts if count in result.cases]
    measured = [column for column in COLUMNS if any(_value(means, column) is not None for _, _, means in rows)]
    table = Table()
    for heading in ("capture", "views"):
        table.add_column(heading)
    for heading, _, _ in measured:
        table.add_column(heading, justify="right")
    for name, count, means in rows:
        table.add_row(name, str(count), *(_cell(means, column) for column in measured))
    table.add_section()
    for count in counts:
        having = sum(count in result.cases for result in results)
        if having:
            means = mean_of_captures(results, count)
            table.add_row(f"mean of {having}", str(count), *(_cell(means, column) for column in measured))
    say(f"real captures at {size}, PSNR in dB; {PAIR} views: triples, more: the middle of a path of views")
    print_table(table)
    for result in results:
        for count, cases in result.cases.items():
            if cases[0].left_out:
                left_out = ", ".join(cases[0].left_out)
                say(f"{result.name}, {count} views: without {left_out}, which `infer` leaves out, too")


def write_capture_results(folder: Path, result: "CaptureEvaluation") -> Path:
    """Write `results.json`: what was evaluated, the means by number of views, every capture; returns its path."""
    counts, results = result.view_counts, result.captures
    present = [count for count in counts if any(count in result.cases for result in results)]
    content = {
        "command": "captures",
        "views": counts,
        **describe(result),
        "mean": {str(count): mean_of_captures(results, count) for count in present},
        "captures": [
            {
                "name": result.name,
                "kind": result.kind,
                "mean": {str(count): result.mean(count) for count in result.cases},
                "cases": {str(count): [asdict(case) for case in cases] for count, cases in result.cases.items()},
            }
            for result in results
        ],
    }
    return write_json(folder, content)


def _cell(means: Scores, column: Column) -> str:
    value = _value(means, column)
    return "" if value is None else f"{value:.{DECIMALS.get(column[2], 2)}f}"


def _value(means: Scores, column: Column) -> float | None:
    _, method, metric = column
    return means.get(method, {}).get(metric)
