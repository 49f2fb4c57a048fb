"""Reports of an evaluation on captures: tables on the terminal, and results.json."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from ....runtime.cli.terminal import say
from ..novel_views import MODEL, NEAREST, ORACLE_PLANE, Scores
from ..report import describe, print_table, write_json
from .capture import PAIR
from .scores import PAIRS, CaptureScores, mean_of_captures

if TYPE_CHECKING:
    from ..evaluate import CaptureEvaluation

# Heading, method and metric of a column of means.
COLUMNS = (
    ("PSNR", MODEL, "psnr"),
    ("fitted", MODEL, "psnr_fitted"),
    ("SSIM", MODEL, "ssim"),
    ("LPIPS", MODEL, "lpips"),
    ("nearest", NEAREST, "psnr"),
    ("oracle\nplane", ORACLE_PLANE, "psnr"),
    ("oracle plane,\nfitted", ORACLE_PLANE, "psnr_fitted"),
    ("from the\ntwo around", PAIRS, "psnr"),
    ("input\nviews", MODEL, "input_psnr"),
)
DECIMALS = {"ssim": 3, "lpips": 3}


def print_captures(results: Sequence[CaptureScores], counts: Sequence[int], size: str) -> None:
    """A row for each capture and number of views, then the means over captures."""
    table = Table()
    for heading in ("capture", "views"):
        table.add_column(heading)
    for heading, _, _ in COLUMNS:
        table.add_column(heading, justify="right")
    for result in results:
        for count in counts:
            if count in result.cases:
                table.add_row(result.name, str(count), *_cells(result.mean(count)))
    table.add_section()
    for count in counts:
        having = sum(count in result.cases for result in results)
        if having:
            table.add_row(f"mean of {having}", str(count), *_cells(mean_of_captures(results, count)))
    say(f"real captures at {size}, PSNR in dB; {PAIR} views: triples, more: the middle of a path of views")
    print_table(table)


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


def _cells(means: Scores) -> list[str]:
    values = [(metric, means.get(method, {}).get(metric)) for _, method, metric in COLUMNS]
    return ["" if value is None else f"{value:.{DECIMALS.get(metric, 2)}f}" for metric, value in values]
