"""Reports of a benchmark: rows, tables, the JSON file, the comparison with an earlier one; the execution providers."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from rich.console import Console
from rich.table import Table

from ...runtime.cli.outputs import write_json
from ...runtime.cli.terminal import literal, warn
from ...runtime.errors import InputError
from ...runtime.inference.providers import (
    CPU,
    Provider,
    all_providers,
    device_type,
    devices_of,
    is_built_in,
    is_installed,
)
from ...runtime.system.files import read_bytes

VERSION = 2  # of the JSON's layout; version 1 had no such field
WIDTH = 150  # columns, if the output is not a terminal
SHOWN = 7  # operators of a row
# Medians within this factor are not a regression, whatever the spread.
TOLERANCE = 1.05
LOST = "can no longer be measured"


@dataclass
class Row:
    """One model, or one network in PyTorch, on one workload; each list has an entry for every round."""

    model: str
    preset: str
    precision: str
    provider: str
    views: int
    height: int
    width: int
    checkpoint: str = ""  # SHA-256
    seconds: list[float] = field(default_factory=list)
    # In the same rounds: the GEMM reference's FLOP per second, and the seconds of the same network in eager PyTorch.
    gemm_rates: list[float] = field(default_factory=list)
    eager_seconds: list[float] = field(default_factory=list)
    load_seconds: float | None = None
    peak_bytes: int | None = None
    # Median relative difference of its depth from that of the first model of the same checkpoint.
    depth_error: float | None = None
    # Of this graph, and the fewest of any graph of the same network and workload.
    flop: int | None = None
    roofline_flop: int | None = None
    operators: dict[str, float] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    # Why measurements are missing.
    problem: str | None = None

    @property
    def name(self) -> str:
        """The row's title."""
        return f"{self.model} ({self.precision}) on {self.provider}, {self.views} views {self.height}x{self.width}"

    @property
    def key(self) -> tuple:
        """Identifies the same row of two benchmarks."""
        return self.model, self.preset, self.precision, self.provider, self.views, self.height, self.width

    @property
    def effort(self) -> np.ndarray:
        """Each run's time in FLOP of the GEMM reference of its round, so that the machine's current speed cancels."""
        return np.multiply(self.seconds, self.gemm_rates)

    @property
    def to_eager(self) -> float | None:
        """Time relative to eager PyTorch, the median over the rounds."""
        return float(np.median(np.divide(self.seconds, self.eager_seconds))) if self.eager_seconds else None

    @property
    def to_roofline(self) -> float | None:
        """Time relative to the roofline: the graph's FLOP at the rate of the GEMM reference; median over the rounds."""
        return float(np.median(self.effort) / self.roofline_flop) if self.roofline_flop and self.seconds else None


def print_rows(rows: Sequence[Row]) -> None:
    """Print the table of times and memory, then that of the time's shares by operator and stage."""
    table = Table()
    for name in ("model", "precision", "on", "views", "size"):
        table.add_column(name, no_wrap=True)
    for name in ("seconds", "spread", "/ eager", "/ roofline", "GFLOP", "peak GB", "opened in", "depth off"):
        table.add_column(name, justify="right")
    for row in rows:
        names = (literal(row.model), row.precision, row.provider, str(row.views), f"{row.height}x{row.width}")
        table.add_row(*names, *_numbers(row))
    print_table(table)
    shares = Table()
    for name in ("model", "views", "size", "operators", "stages"):
        shares.add_column(name, no_wrap=name == "model")
    for row in rows:
        if row.operators:
            size = f"{row.height}x{row.width}"
            shares.add_row(literal(row.model), str(row.views), size, _shares(row.operators), _shares(row.stages))
    if shares.rows:
        print_table(shares)


def write_rows(path: Path, machine: dict[str, Any], rows: Sequence[Row]) -> None:
    """Write the machine and all rows as JSON."""
    content = {"version": VERSION, "machine": machine, "rows": [asdict(row) for row in rows]}
    write_json(path, json.dumps(content, indent=1))


def read_rows(path: Path) -> list[Row]:
    """The rows of a file that `write_rows` wrote; raises InputError."""
    try:
        content = json.loads(read_bytes(path, "what --json of idesplat bench wrote"))
        if content.get("version", 1) != VERSION and content["rows"]:
            raise InputError(f"{path}: is of an older layout of --json; measure it again with this version")
        return [Row(**entry) for entry in content["rows"]]
    except InputError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise InputError(f"{path}: not what --json of this version of idesplat bench writes") from None


def compare(rows: Sequence[Row], before: Sequence[Row]) -> list[str]:
    """Print the changes since an earlier benchmark; returns a line for each regression.

    Times are relative to the GEMM reference of the same rounds. A row is slower if its median is more than 5 % higher
    and its first quartile is above the earlier third quartile. Memory regresses by more than 5 %. A row that was
    measured and now has a problem instead is a regression. Warns of rows of one benchmark alone, and raises InputError
    if no row is in both.
    """
    known = {row.key: row for row in before if row.seconds}
    now = {row.key: row for row in rows}
    if not known.keys() & now.keys():
        raise InputError("none of its rows is measured here; give the same models, --views, --sizes and --provider")
    for row in (row for key, row in now.items() if key not in known):
        warn(f"{row.name}: not in the earlier benchmark, so not compared")
    for row in (row for key, row in known.items() if key not in now):
        warn(f"{row.name}: in the earlier benchmark alone, so not compared")
    table = Table(title="changes", title_justify="left")
    table.add_column("model")
    for name in ("time", "memory"):
        table.add_column(name, justify="right")
    table.add_column("regression")
    worse = []
    for row in rows:
        old = known.get(row.key)
        if old is None:
            continue
        verdicts = _verdicts(row, old) if row.seconds else [LOST]
        time = f"{np.median(row.effort) / np.median(old.effort):.2f}" if row.seconds else ""
        memory = f"{row.peak_bytes / old.peak_bytes:.2f}" if row.peak_bytes and old.peak_bytes else ""
        table.add_row(literal(row.name), time, memory, ", ".join(verdicts))
        worse += [f"{row.name}: {verdict}" for verdict in verdicts]
    print_table(table)
    return worse


def _verdicts(row: Row, old: Row) -> list[str]:
    """The regressions of a row: slower, more memory."""
    verdicts = []
    slower = np.median(row.effort) > TOLERANCE * np.median(old.effort)
    if slower and np.percentile(row.effort, 25) > np.percentile(old.effort, 75):
        verdicts.append("slower")
    if row.peak_bytes and old.peak_bytes and row.peak_bytes > TOLERANCE * old.peak_bytes:
        verdicts.append("more memory")
    return verdicts


def _numbers(row: Row) -> list[str]:
    """A row's cells from the column of seconds on."""
    low, median, high = np.percentile(row.seconds, (25, 50, 75))
    return [
        f"{median:.3g}",
        f"{(high - low) / median:.0%}",
        _number(row.to_eager, "{:.2f}"),
        _number(row.to_roofline, "{:.2f}"),
        _number(row.flop and row.flop / 1e9, "{:.0f}"),
        _number(row.peak_bytes and row.peak_bytes / 1e9, "{:.2f}"),
        _number(row.load_seconds, "{:.2f} s"),
        _number(row.depth_error, "{:.0e}"),
    ]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _shares(shares: dict[str, float]) -> str:
    return ", ".join(f"{name} {share:.0%}" for name, share in list(shares.items())[:SHOWN])


def print_providers() -> None:
    """Print every known provider, the package that has it, what of it is here, and what of it was tried."""
    table = Table(title=f"execution providers of ONNX Runtime {onnxruntime.__version__}", title_justify="left")
    for name in ("--provider", "package", "runs on", "here", "tried by the project"):
        table.add_column(name, no_wrap=name in ("--provider", "package"))
    for provider in all_providers():
        cells = (provider.name, provider.package, provider.hardware, _state(provider), provider.tried)
        table.add_row(*map(literal, cells))
    print_table(table)


def _state(provider: Provider) -> str:
    """Whether a provider is installed, and the devices that it finds."""
    if not is_installed(provider):
        return "not installed"
    if provider.ep_name == CPU:
        return "yes"
    if is_built_in(provider):
        return "installed"
    try:
        devices = devices_of(provider)
    except InputError as error:
        return f"{provider.version}: {error}"
    found = ", ".join(f"{index} {device_type(device)}" for index, device in enumerate(devices)) or "none"
    return f"{provider.version}, devices: {found}"


def print_table(table: Table) -> None:
    """Print a table, wide where the output is no terminal."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(table)
