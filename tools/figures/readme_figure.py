"""The README's image: input, depth, rendered held-out view and truth, of the synthetic room by the bundled model.

python -P -m idesplat.tools.figures.readme_figure demo/scene docs/images/readme.png
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ...runtime.cameras.io import read_cameras
from ...runtime.cli.terminal import run, say
from ...runtime.geometry.intrinsics import denormalize_intrinsics
from ...runtime.images.colormaps import colormap_depth
from ...runtime.images.png import save_png
from ...runtime.inference.bundled_model import bundled_model
from ...runtime.inference.predictor import Predictor
from ...runtime.rendering.render import render_view
from ...runtime.views.batch import build_view_batch

CONTEXT, HELD_OUT = (1, 3), 2


def image(
    scene: Annotated[Path, typer.Argument(help="Folder that make_scene wrote.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="The .png to write.", show_default=False)],
) -> None:
    """Write a strip: first input, its depth, the held-out view rendered and as it is, second input."""
    cameras = read_cameras(scene / "transforms.json")
    predictor = Predictor(bundled_model())
    height, width = predictor.model.size_for(cameras)
    pairs = [(scene / cameras[view].name, cameras[view]) for view in (*CONTEXT, HELD_OUT)]
    given = build_view_batch(pairs[: len(CONTEXT)], None, height, width)
    found = predictor.predict_views(given)
    views = build_view_batch(pairs, None, height, width)
    K = denormalize_intrinsics(views.intrinsics[-1], width, height)
    rendered = render_view(found.need_gaussians(), views.extrinsics[-1], K, width, height).rgb
    first, second, truth = views.images.transpose(0, 2, 3, 1)
    save_png(out, np.hstack([first, colormap_depth(found.depth[0]), rendered, truth, second]).astype(np.float32))
    say(f"wrote {out}")


def main() -> None:
    """Run the command."""
    run(image)


if __name__ == "__main__":
    main()
