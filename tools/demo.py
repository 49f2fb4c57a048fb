"""The main job on a scene drawn here: photographs, a checkpoint, the export, and what comes out of it.

python -m idesplat.tools.demo demo
"""

from pathlib import Path
from typing import Annotated

import torch
import typer

from ..export.cli import export
from ..model.networks import build
from ..runtime.cli import infer
from ..runtime.errors import exit_on_input_error
from ..runtime.files import make_folder, replacing
from .make_scene import make_scene

PRESET = "idesplat-tiny"
SEED = 0


@exit_on_input_error
def demo(out: Annotated[Path, typer.Argument(help="Folder for everything.")] = Path("demo")) -> None:
    """Draw a room, export a network with untrained weights, and run it on two photographs of the room."""
    make_folder(out)
    scene, checkpoint, model = out / "scene", out / f"{PRESET}-untrained.pth", out / "untrained.onnx"
    make_scene(scene, seed=2, views=8, height=480, width=640)
    torch.manual_seed(SEED)
    with replacing(checkpoint) as temporary:
        torch.save(build(PRESET).state_dict(), temporary)
    print(f"a network of preset {PRESET} with random weights is in {checkpoint}")
    export(checkpoint, model, preset=PRESET)
    print("\nThe weights are UNTRAINED: expect every file, in its right place and format, and a meaningless scene.")
    infer(
        images=[scene / "images"],
        cameras=scene / "transforms.json",
        out=out / "scene.ply",
        model=model,
        save_depth=out / "depth",
        render=out / "views",
        timings=True,
        json_path=out / "summary.json",
    )
    print("The weights are UNTRAINED; a released checkpoint goes the same way (see README.md).")


def main() -> None:
    """Run the command."""
    typer.run(demo)


if __name__ == "__main__":
    main()
