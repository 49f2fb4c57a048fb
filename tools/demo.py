"""The main job on a scene drawn here: photographs and cameras, and what the carried model makes of them.

python -P -m idesplat.tools.demo demo
"""

from pathlib import Path
from typing import Annotated

import typer

from ..runtime.cli import infer
from ..runtime.errors import exit_on_input_error
from ..runtime.files import make_folder
from ..runtime.terminal import run
from .make_scene import make_scene


@exit_on_input_error
def demo(out: Annotated[Path, typer.Argument(help="Folder for everything.")] = Path("demo")) -> None:
    """Draw a room, and turn two photographs of it into splats, depth maps and views."""
    scene = make_folder(out) / "scene"
    make_scene(scene, seed=2, views=8, height=480, width=640)
    infer(
        images=[scene / "images"],
        cameras=str(scene / "transforms.json"),
        out=out / "scene.ply",
        save_depth=out / "depth",
        render=out / "views",
        timings=True,
        json_path=out / "summary.json",
    )


def main() -> None:
    """Run the command."""
    run(demo)


if __name__ == "__main__":
    main()
