"""Every variant on every reference case: error against the release, and relative time; a table of docs/parity.md.

PYTHONPATH=tests/support python tests/support/measure_parity.py
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from idesplat.export.conversion import build_metadata
from idesplat.export.precision.convert import PRECISIONS
from idesplat.export.stages import NamedTensors
from idesplat.export.tracing import StaticShape, export_graphs
from idesplat.export.validation.cases import Case
from idesplat.export.validation.compare import Exported, compare
from idesplat.model.checkpoint import fill
from idesplat.model.common.gaussian_adapter import WorldGaussians
from idesplat.model.common.network import Network
from idesplat.model.registry import build
from idesplat.runtime.inference.metadata import INPUTS
from idesplat.runtime.inference.session import SessionConfig, open_session, run_session
from parity_cases import CASES as IDESPLAT_CASES
from parity_cases import DEPTHSPLAT_CASES as DEPTHSPLAT_CASES
from parity_cases import as_reference
from reference_weights import random_state_dict, read_arrays, read_meta
from rich.console import Console
from rich.table import Table

THREADS = 1
ROUNDS = 3
CLOSE = 1e-3  # of the depth
COLUMNS = ("depths within 1e-3", "median", "largest", "Gaussians, median", "worst stage", "time / PyTorch")
TENSORS = ("depth", *WorldGaussians._fields)

Run = Callable[[], dict[str, torch.Tensor]]


@torch.no_grad()
def main() -> None:
    """Print the table, a case at a time."""
    torch.set_num_threads(THREADS)
    for case, preset in {**IDESPLAT_CASES, **DEPTHSPLAT_CASES}.items():
        model = build(preset).eval()
        fill(model, random_state_dict(case), Path(case))
        arrays = read_arrays(case)
        inputs = [arrays["image"] / 255, *(arrays[name] for name in INPUTS[1:])]
        with tempfile.TemporaryDirectory() as folder:
            report(case, *variants(model, inputs, Path(folder)))


def variants(
    model: Network, inputs: list[torch.Tensor], folder: Path
) -> tuple[dict[str, Run], dict[str, float | None]]:
    """What runs the case, by name; and of each graph the largest median error of a tensor that a stage yields.

    That is against PyTorch's own, from which each stage starts, in standard deviations.
    """

    def eager() -> dict[str, torch.Tensor]:
        predicted = model(*inputs)
        return dict(zip(TENSORS, (predicted.depth, *predicted.gaussians), strict=True))

    network = NamedTensors(model)
    feeds = {name: value.numpy() for name, value in zip(INPUTS, inputs, strict=True)}
    between = Case("", len(inputs[0]), feeds | {name: value.numpy() for name, value in network.named(*inputs).items()})
    runs: dict[str, Run] = {"PyTorch": eager}
    stages: dict[str, float | None] = {"PyTorch": None}
    for precision in PRECISIONS:
        (folder / precision).mkdir()
        graphs = export_graphs(
            network, build_metadata(model, "", "", "", StaticShape(), precision), StaticShape(), folder / precision
        )
        exported = Exported([(stage, graphs.of_stage(stage)) for stage in graphs.stages], staged=False)
        rows = compare(exported, [between], network.family.tolerances[precision])
        stages[precision] = max(row.errors.median for row in rows)
        session = open_session(graphs.whole, config=SessionConfig(THREADS))
        runs[precision] = lambda session=session: {
            name: torch.from_numpy(value) for name, value in run_session(session, feeds).items()
        }
    return runs, stages


def report(case: str, runs: dict[str, Run], stages: dict[str, float | None]) -> None:
    """Print the rows of a case; its variants run in turn, round by round, after a first one that nobody counts."""
    table = Table(title=case, title_justify="left")
    table.add_column("")
    for column in COLUMNS:
        table.add_column(column, justify="right")
    found = {name: run() for name, run in runs.items()}
    seconds = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            started = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - started)
    for name, result in found.items():
        ratio = np.median(np.divide(seconds[name], seconds["PyTorch"]))
        stage = "" if stages[name] is None else f"{stages[name]:.1e}"
        table.add_row(name, *departure(case, result), stage, f"{ratio:.2f}")
    Console(width=120).print(table)


def departure(case: str, found: dict[str, torch.Tensor]) -> list[str]:
    """How far the depth is from the release's, in relative terms, and the Gaussians, in standard deviations."""
    expected, meta = read_arrays(case), read_meta(case)
    error = (found["depth"] - expected["depth"]).abs() / expected["depth"]
    step = meta["gaussian_stride"]
    kept = [found[name].unflatten(0, error.shape)[:, ::step, ::step].flatten(0, 2) for name in TENSORS[1:]]
    pairs = as_reference(WorldGaussians(*kept), expected).values()
    gaussians = max(float((ours - reference).abs().median() / reference.std()) for ours, reference in pairs)
    share = 100 * (error <= CLOSE).double().mean()
    return [f"{share:.2f} %", f"{error.median():.1e}", f"{error.max():.1e}", f"{gaussians:.1e}"]


if __name__ == "__main__":
    main()
