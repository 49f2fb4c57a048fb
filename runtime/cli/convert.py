"""The command `idesplat convert`: one splat file to another."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..system.outputs import outputs
from .options import Config, Overwrite, Quiet, Verbose
from .outputs import command
from .reporting import note
from .terminal import run, say


@command("idesplat convert")
def convert(
    scene: Annotated[Path, typer.Argument(help="Splat file to read.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
    min_opacity: Annotated[float, typer.Option(help="Leave out Gaussians of lower opacity, 0 to 1.")] = 0,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Convert a splat file to the format that the output's suffix names.

    .ply, .compressed.ply, .splat, .spz, .sog and .glb are read and written; .points.ply, .points.glb, .obj and .xyz are
    written as points. What a format cannot hold is reported.
    """
    from ..splats.filtering import describe_removed
    from ..splats.io import read_offset, read_splats, splat_suffix, write_splats

    splat_suffix(out)
    outputs().reads("the scene", [scene])
    outputs().writes("", [out])
    if not 0 <= min_opacity <= 1:
        raise InputError(f"--min-opacity {min_opacity:g}: expected a number from 0 to 1")
    gaussians = read_splats(scene)
    if min_opacity:
        whole, gaussians = len(gaussians), gaussians.select(gaussians.opacities >= min_opacity)
        if not len(gaussians):
            raise InputError(f"--min-opacity {min_opacity:g}: no Gaussian is left of {whole}; use a smaller one")
        note(describe_removed({"min_opacity": whole - len(gaussians)}, len(gaussians)))
    for line in write_splats(out, gaussians, read_offset(scene)):
        note(f"note: {line}")
    say(f"wrote {out}: {len(gaussians):,} Gaussians, {out.stat().st_size / 1e6:.1f} MB")


def main() -> None:
    """Run the command."""
    run(convert)
