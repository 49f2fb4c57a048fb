"""Reports of an evaluation: tables on the terminal, and results.json."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ...runtime.cli.terminal import literal, say
from ...runtime.system.files import atomic_write
from ...runtime.system.output_names import RESULTS
from .metrics import LITE0, LITE0_TITLE, LPIPS
from .novel_views import MODEL, NEAREST, ORACLE_DEPTH, ORACLE_PLANE, Result, Scores

if TYPE_CHECKING:
    from .evaluate import CaptureEvaluation, Evaluation

TITLES = {
    "psnr": "PSNR, dB",
    "psnr_covisible": "PSNR co-visible, dB",
    "ssim": "SSIM",
    LPIPS: "LPIPS",
    LITE0: LITE0_TITLE,
    "abs_rel": "AbsRel",
    "abs_rel_covisible": "AbsRel co-visible",
    "delta_1.25": "delta < 1.25",
    "inlier_ratio_1.05": "inlier ratio at 1.05",
}
DECIMALS = {"psnr": 2, "psnr_covisible": 2}
DEFAULT_DECIMALS = 3
METHODS = {MODEL: "model", NEAREST: "nearest", ORACLE_PLANE: "oracle plane", ORACLE_DEPTH: "oracle depth"}
WIDTH = 150  # columns, where the output is no terminal


def print_views(results: Sequence[Result]) -> None:
    """Print a row for each target view, with every method's metrics; those that a view lacks are empty."""
    scores = [target.scores for result in results for target in result.targets]
    methods = dict.fromkeys(method for view in scores for method in view)
    metrics = dict.fromkeys(metric for view in scores for metric in view[MODEL])
    columns = [(metric, method) for metric in metrics for method in methods]
    table = Table()
    table.add_column("target", no_wrap=True)
    table.add_column("from")
    for metric, method in columns:
        heading = TITLES[metric] if method == MODEL else ""
        table.add_column(f"{heading}\n{METHODS[method]}", justify="right", no_wrap=True)
    for result in results:
        for target in result.targets:
            found = [(metric, target.scores.get(method, {}).get(metric)) for metric, method in columns]
            cells = ["" if value is None else _number(metric, value) for metric, value in found]
            table.add_row(literal(target.name), literal(", ".join(result.context)), *cells)
    print_table(table)


def print_means(means: Scores, title: str) -> None:
    """Print a title and a row for each metric: its mean by method, and the model's difference to each baseline."""
    table = Table()
    table.add_column("mean")
    for method in means:
        table.add_column(METHODS[method], justify="right")
    compared = [method for method in means if method != MODEL]
    for method in compared:
        table.add_column(f"over {METHODS[method]}", justify="right")
    for metric, value in means[MODEL].items():
        others = [means[method].get(metric) for method in compared]
        cells = ["" if other is None else _number(metric, other) for other in others]
        gains = ["" if other is None else _number(metric, value - other, sign="+") for other in others]
        table.add_row(TITLES[metric], _number(metric, value), *cells, *gains)
    say(title)
    print_table(table)


def write_results(folder: Path, options: dict[str, Any], result: "Evaluation") -> Path:
    """Write `results.json`: what was evaluated, the means, every scene and every target; returns its path."""
    return write_json(
        folder,
        {
            **options,
            **describe(result),
            "skipped": result.skipped,
            "missing": result.missing,
            "mean": result.mean,
            "scenes": [asdict(scene) for scene in result.scenes],
        },
    )


def describe(result: "Evaluation | CaptureEvaluation") -> dict[str, Any]:
    """The fields of `results.json` that say what was evaluated."""
    return {"size": result.size, "model": {"path": str(result.model), **asdict(result.metadata)}}


def write_json(folder: Path, content: dict[str, Any]) -> Path:
    """Write `results.json` in a folder; returns its path."""
    path = folder / RESULTS
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n")
    return path


def _number(metric: str, value: float, sign: str = "") -> str:
    return f"{value:{sign}.{DECIMALS.get(metric, DEFAULT_DECIMALS)}f}"


def print_table(table: Table) -> None:
    """Print a table, at a fixed width where the output is no terminal."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(table)
