"""Export a trained checkpoint as the bundled model.

    python -P -m idesplat.tools.training.release runs/head/last.ckpt

The verified ONNX graph goes to `runtime/inference/bundled/`, with its checksum. It is one for the web, which is as fast
elsewhere, so that the page of `idesplat web` can run it on WebGPU. The weights go to `bundled.safetensors` beside this
file, which no package contains: from them the graph is exported again, and training goes on
(`idesplat train --init tools/training/bundled.safetensors`).
"""

import hashlib
from pathlib import Path
from typing import Annotated

import typer
from safetensors.torch import save_file

from ...export.pipeline import export_checkpoint
from ...export.targets import WEB
from ...model.checkpoint import load_checkpoint
from ...runtime.cli.terminal import run
from ...runtime.inference.bundled_model import CHECKSUM_SUFFIX, FOLDER, NAME
from ...runtime.system.files import atomic_write, make_folder

PRESET = "idesplat-lite"
WEIGHTS = Path(__file__).with_name("bundled.safetensors")


def release_bundled_model(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint that `idesplat train` wrote.", show_default=False)],
    preset: Annotated[str, typer.Option(help="The network.")] = PRESET,
) -> None:
    """Export a checkpoint as the bundled model."""
    path = make_folder(FOLDER) / NAME
    export_checkpoint(checkpoint, path, preset=preset, target=WEB)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with atomic_write(path.with_name(NAME + CHECKSUM_SUFFIX)) as temporary:
        temporary.write_text(f"{digest}  {NAME}\n")
    with atomic_write(WEIGHTS) as temporary:
        save_file(load_checkpoint(checkpoint, preset).state_dict(), temporary)


def main() -> None:
    """Run the command."""
    run(release_bundled_model)


if __name__ == "__main__":
    main()
