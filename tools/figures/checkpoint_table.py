"""The table of supported checkpoints for the documentation, with every number measured on this machine.

    python -P -m idesplat.tools.figures.checkpoint_table
    python -P -m idesplat.tools.figures.checkpoint_table depthsplat-small-re10k depthsplat-base-re10k

Each preset's network gets random weights, is exported by idesplat-export and run, each in a process of its own. Time
and memory do not depend on the weights. Parity is not better than with trained weights, since features of neighbouring
pixels are then uncorrelated. Seconds are CPU time of one thread, which does not depend on the load of the machine.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from ...export.pipeline import export_checkpoint
from ...model.common.network import Network
from ...model.registry import PRESETS, build, family_of
from ...runtime.cli.terminal import run, say
from ...runtime.errors import InputError
from ...runtime.inference.normalization import SceneNormalization
from ...runtime.inference.providers import CPU
from ...runtime.inference.session import SessionConfig
from ...runtime.system.files import scratch_folder
from ..benchmark.runner import thread_environment
from ..benchmark.worker import Failed, Prepared, Worker, Workload, example_arrays, exported

# Released files by preset; an asterisk stands for an unknown part of the name.
RELEASED = {
    "idesplat-re10k": "idesplat-re10k-256x256-view2.ckpt",
    "idesplat-acid": "idesplat-acid-256x256-view2.ckpt",
    "idesplat-dl3dv": "idesplat-dl3dv-256x448-randview2-6.ckpt",
    "depthsplat-small-re10k": "depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth",
    "depthsplat-base-re10k": "depthsplat-gs-base-re10k-256x256-view2-ca7b6795.pth",
    "depthsplat-large-re10k": "depthsplat-gs-large-re10k-256x256-view2-e0f0f27a.pth",
    "depthsplat-base-re10k-256x448": "depthsplat-gs-base-re10k-256x448-view2-fea94f65.pth",
    "depthsplat-base-dl3dv": "depthsplat-gs-base-dl3dv-256x448-randview2-6-02c7b19d.pth",
    "depthsplat-small-re10kdl3dv": "depthsplat-gs-small-re10kdl3dv-448x768-randview4-10-c08188db.pth",
    "depthsplat-base-re10kdl3dv": "depthsplat-gs-base-re10kdl3dv-448x768-randview2-6-f8ddd845.pth",
    "depthsplat-depth-small": "depthsplat-depth-small-352x640-randview2-8-e807bd82.pth",
    "depthsplat-depth-base": "depthsplat-depth-base-352x640-randview2-8-65a892c5.pth",
}
# Scales of the random weights, as in the reference cases.
GAIN = 0.7
BIAS = 0.1
TABLES = 0.02
VIEWS = 2
TOLERANCE = 1e-3
COLUMNS = (
    "checkpoint",
    "family",
    "preset",
    "parameters",
    "trained at",
    "views",
    "depth as in PyTorch",
    "seconds",
    "peak memory",
    "file",
    "export",
)
GB = 1e9


@dataclass(frozen=True)
class Measured:
    """Measurements of one preset on two views of the trained size, and of its export."""

    parameters: int
    share: float  # of depths whose relative difference from PyTorch is at most `TOLERANCE`
    median: float  # relative error
    seconds: float
    peak_bytes: int
    file_bytes: int
    export_seconds: float
    export_peak_bytes: int


def table(
    presets: Annotated[
        list[str] | None, typer.Argument(help="Presets instead of all released ones.", show_default=False)
    ] = None,
    repeats: Annotated[int, typer.Option(help="Runs, of which the median counts.", min=1)] = 3,
) -> None:
    """Print a row of Markdown for each preset as soon as it is measured."""
    for name in presets or []:
        if name not in RELEASED:
            raise InputError(f"{name}: unknown preset; choose of {', '.join(RELEASED)}")
    say("| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS))
    with thread_environment(1):
        for name in presets or RELEASED:
            try:
                say(row(name, measure(name, repeats)))
            except Failed as error:
                raise InputError(f"{name}: {error}") from None


def row(preset: str, found: Measured) -> str:
    """A row of Markdown."""
    config = PRESETS[preset]
    fewest, most = config.trained_views
    cells = (
        f"`{RELEASED[preset]}`",
        family_of(config).name,
        f"`{preset}`",
        f"{found.parameters / 1e6:.1f} M",
        f"{config.height}x{config.width}",
        f"{fewest}" if fewest == most else f"{fewest} to {most}",
        f"{100 * found.share:.2f} % ({found.median:.0e})",
        f"{found.seconds:.1f}",
        f"{found.peak_bytes / GB:.1f} GB",
        f"{found.file_bytes / GB:.2f} GB",
        f"{found.export_seconds:.0f} s, {found.export_peak_bytes / GB:.1f} GB",
    )
    return "| " + " | ".join(cells) + " |"


def measure(preset: str, repeats: int) -> Measured:
    """Write a checkpoint with random weights, export it and run the graph. Raises Failed if that fails."""
    config = PRESETS[preset]
    workload = Workload(VIEWS, config.height, config.width)
    with scratch_folder() as folder:
        checkpoint, model = folder / "random.pth", folder / "model.onnx"
        with Worker(reference, preset, checkpoint, workload) as worker:
            parameters, depth = worker.about
        with Worker(exporting, checkpoint, preset, model) as worker:
            export_seconds = worker.run().result
            export_peak = worker.finish()
        with Worker(running, model, workload) as worker:
            seconds = float(np.median([worker.run().result for _ in range(repeats)]))
            error = np.abs(worker.about["depth"] - depth) / depth
            peak = worker.finish()
        size = sum(path.stat().st_size for path in folder.glob("model.onnx*"))
    share, median = float((error <= TOLERANCE).mean()), float(np.median(error))
    return Measured(parameters, share, median, seconds, peak or 0, size, export_seconds, export_peak or 0)


# ---- candidates, each in a process of its own


def reference(preset: str, checkpoint: Path, workload: Workload) -> Prepared:
    """Write a checkpoint of random weights; `about` holds their number, and the depth that PyTorch predicts."""
    network = build(preset).eval()
    randomize_weights(network)
    torch.save({"state_dict": network.state_dict()}, checkpoint)
    images, extrinsics, intrinsics, near, far = example_arrays(workload, network.config.near, network.config.far)
    frame = SceneNormalization.of(extrinsics, near, network.config.near)
    arrays = images, frame.apply(extrinsics), intrinsics, near, far
    with torch.inference_mode():
        depth = network(*(torch.from_numpy(array) for array in arrays)).depth.numpy()
    count = sum(parameter.numel() for parameter in network.parameters())
    return (count, frame.invert_depth(depth)), dict


def exporting(checkpoint: Path, preset: str, model: Path) -> Prepared:
    """The export; a run gives its CPU seconds."""

    # ONNX Runtime starts a thread for each usable core, and idle threads would add CPU time.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    def run() -> None:
        export_checkpoint(checkpoint, model, preset=preset)

    return None, _timed(run)


def running(model: Path, workload: Workload) -> Prepared:
    """The exported model; `about` holds its predicted depth, and a run gives its CPU seconds."""
    about, run = exported(model, CPU, SessionConfig(1), workload)
    return about, _timed(run)


def _timed(run: Callable[[], object]) -> Callable[[], float]:
    """A function that runs another and returns the CPU seconds."""

    def timed() -> float:
        started = time.process_time()
        run()
        return time.process_time() - started

    return timed


def randomize_weights(network: Network, seed: int = 0) -> None:
    """Fill a network with random weights that preserve the signal's magnitude, as in the reference cases."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            values = torch.randn(parameter.shape, generator=generator)
            if name.endswith(("embed", "token", "position", "position_bias")):
                values *= TABLES
            elif parameter.dim() > 1:
                values *= GAIN / math.sqrt(math.prod(parameter.shape[1:]))
            elif name.endswith("bias"):
                values *= BIAS
            else:  # of normalisations and layer scales
                values = 1 + BIAS * values
            parameter.copy_(values)


def main() -> None:
    """Run the command."""
    run(table)


if __name__ == "__main__":
    main()
