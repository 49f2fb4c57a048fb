"""The command idesplat-cameras: cameras of any format to this project's JSON, or to transforms.json."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..cameras.formats import CameraFormat
from ..errors import InputError, exit_on_input_error
from .outputs import Overwrite, guards_outputs, outputs
from .terminal import run, say

if TYPE_CHECKING:
    from ..cameras.camera import Camera

app = typer.Typer(add_completion=False, help="Cameras from any format that is known.", no_args_is_help=True)


@app.callback()
def _commands() -> None:
    """Make `convert` a word of its own, though it is alone so far."""


@app.command()
@exit_on_input_error
@guards_outputs("idesplat-cameras")
def convert(
    cameras: Annotated[Path, typer.Argument(help="File or folder of cameras of any known format.", show_default=False)],
    out: Annotated[
        Path,
        typer.Argument(help="JSON to write; nerfstudio's layout if it is called transforms.json.", show_default=False),
    ],
    images: Annotated[
        list[Path] | None,
        typer.Option(help="Folder, glob or files of the photographs, where a format does not name or measure them."),
    ] = None,
    more_images: Annotated[list[Path] | None, typer.Argument(hidden=True)] = None,
    camera_format: Annotated[
        CameraFormat | None, typer.Option(help="Format of the cameras, where their content does not tell it.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read cameras and write them as JSON, camera-to-world with OpenCV axes, pixels with centres at .5."""
    from ..cameras.io import detect_format, read_cameras, write_cameras
    from ..images.io import find_images
    from .input_files import camera_files, given_images

    if out.suffix != ".json":
        raise InputError(f"{out}: expected a file that ends in .json")
    pictures = [*(images or []), *(more_images or [])]
    outputs().reads("the cameras", camera_files(cameras))
    outputs().reads("a photograph", given_images(pictures))
    outputs().writes("", [out])
    found = read_cameras(cameras, find_images(pictures) if pictures else (), camera_format)
    write_cameras(out, found)
    say(f"read {len(found)} cameras as {camera_format or detect_format(cameras)}: {_lenses(found)}")
    say(f"wrote {out}")


def main() -> None:
    """Entry point of idesplat-cameras."""
    run(app)


def _lenses(cameras: "Sequence[Camera]") -> str:
    """How many cameras have which size, focal length and lens."""
    kinds = Counter(
        f"{camera.width} x {camera.height}, focal length {camera.K[0, 0]:.1f}, "
        + ("fisheye" if camera.fisheye else "no distortion" if camera.distortion is None else "distorted")
        for camera in cameras
    )
    shown = [f"{count} of {kind}" for kind, count in kinds.most_common(3)]
    return "; ".join([*shown, "..."] if len(kinds) > len(shown) else shown)
