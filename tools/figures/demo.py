"""`make demo`: a synthetic scene, and its reconstruction by the bundled model.

python -P -m idesplat.tools.figures.demo demo
"""

from pathlib import Path
from typing import Annotated

import typer

from ...runtime.cli.infer import infer
from ...runtime.cli.options import Overwrite
from ...runtime.cli.outputs import command
from ...runtime.cli.terminal import run
from ...runtime.system.output_names import SPLATS, SUMMARY
from ...runtime.system.outputs import outputs
from ..synthetic.make_scene import make_scene


@command("demo")
def demo(
    out: Annotated[Path, typer.Argument(help="Folder for everything.")] = Path("demo"), overwrite: Overwrite = False
) -> None:
    """Render images of a synthetic room, and reconstruct splats, depth maps and views from two of them."""
    scene = out / "scene"
    outputs().writes("", [out / f"scene{SPLATS}", out / SUMMARY])
    make_scene(scene, seed=2, views=8, height=480, width=640, overwrite=overwrite)
    infer(
        images=[scene / "images"],
        cameras=str(scene / "transforms.json"),
        out=out / f"scene{SPLATS}",
        save_depth=out / "depth",
        render=out / "views",
        timings=True,
        json_path=out / SUMMARY,
        overwrite=overwrite,
    )


def main() -> None:
    """Run the command."""
    run(demo)


if __name__ == "__main__":
    main()
