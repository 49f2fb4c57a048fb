"""Export a trained checkpoint, or the mean of several, as the bundled model.

    python -P -m idesplat.tools.training.release runs/head/last.ckpt

Runs that start from one another may be averaged; whether that is better than each of them, an evaluation tells.

The verified ONNX graph goes to `runtime/inference/bundled/`, with its checksum. It is one for the web, which is as fast
elsewhere, so that the page of `idesplat web` can run it on WebGPU. The weights go to `bundled.safetensors` beside this
file, which no package contains: from them the graph is exported again, and training goes on
(`idesplat train --init tools/training/bundled.safetensors`).
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer
from safetensors.torch import save_file
from torch import Tensor

from ...export.conversion import load
from ...export.pipeline import export_checkpoint
from ...export.targets import WEB
from ...runtime.cli.terminal import run
from ...runtime.inference.bundled_model import CHECKSUM_SUFFIX, FOLDER, NAME
from ...runtime.system.files import atomic_write, make_folder, scratch_folder

PRESET = "idesplat-lite"
WEIGHTS = Path(__file__).with_name("bundled.safetensors")


def release_bundled_model(
    checkpoints: Annotated[
        list[Path], typer.Argument(help="Checkpoints that `idesplat train` wrote.", show_default=False)
    ],
    preset: Annotated[str, typer.Option(help="The network.")] = PRESET,
) -> None:
    """Export the mean of the checkpoints' weights as the bundled model."""
    weights = mean_weights([load(checkpoint, preset).model.state_dict() for checkpoint in checkpoints])
    path = make_folder(FOLDER) / NAME
    with scratch_folder() as folder:
        save_file(weights, folder / WEIGHTS.name)
        export_checkpoint(folder / WEIGHTS.name, path, preset=preset, target=WEB)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with atomic_write(path.with_name(NAME + CHECKSUM_SUFFIX)) as temporary:
        temporary.write_text(f"{digest}  {NAME}\n")
    with atomic_write(WEIGHTS) as temporary:
        save_file(weights, temporary)


def mean_weights(networks: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The mean of each tensor of networks of one architecture."""
    return {name: torch.stack([weights[name] for weights in networks]).mean(dim=0) for name in networks[0]}


def main() -> None:
    """Run the command."""
    run(release_bundled_model)


if __name__ == "__main__":
    main()
