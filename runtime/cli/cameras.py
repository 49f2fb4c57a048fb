"""The command `idesplat cameras`: cameras estimated from images, or converted from any format."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ..system.output_names import CAMERAS_FILE
from ..system.outputs import outputs
from .options import IMAGES_HELP, CamerasFormat, Config, Focal, Images, MoreImages, Overwrite, Quiet, Verbose
from .outputs import command
from .reporting import note
from .terminal import HELP_OPTIONS, run, say

if TYPE_CHECKING:
    from ..cameras.camera import Camera

OUT_HELP = "JSON to write: our own, or nerfstudio's layout if it is called transforms.json."

app = typer.Typer(
    add_completion=False,
    context_settings=HELP_OPTIONS,
    help="Estimate cameras from images, or convert them between formats.",
    no_args_is_help=True,
)


@app.command()
@command("idesplat cameras estimate")
def estimate(
    photos: Annotated[list[Path] | None, typer.Argument(metavar="PHOTOS", help=IMAGES_HELP, show_default=False)] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help=OUT_HELP)] = Path(CAMERAS_FILE),
    images: Images = None,
    focal: Focal = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Estimate the cameras of images of one static scene, as `idesplat infer` does where it finds none."""
    from ..cameras.camera import named_from
    from ..cameras.io import write_cameras
    from ..images.finding import describe_unsupported
    from ..sfm.estimate import describe_estimate, estimate_cameras
    from ..system.files import scratch_folder
    from ..views.sources import find_input_images
    from .input_files import given_images

    given = [*(images or []), *(photos or [])]
    if not given:
        raise InputError("PHOTOS: none given; give a folder, a glob, files or a video")
    _check_name(out)
    outputs().reads("an image", given_images(given))
    outputs().writes("--out", [out])
    skipped = describe_unsupported(given)
    with scratch_folder() as folder:
        files = find_input_images(given, None, None, folder)
        unsupported = len(skipped)
        cameras = estimate_cameras(files, focal, skipped)
        note(*skipped, describe_estimate(len(files) - len(skipped) + unsupported, cameras))
        write_cameras(out, named_from(out.parent, cameras, folder))
    say(f"wrote {out}")


@app.command()
@command("idesplat cameras convert")
def convert(
    cameras: Annotated[Path, typer.Argument(help="File or folder of cameras of any known format.", show_default=False)],
    out: Annotated[Path, typer.Argument(help=OUT_HELP, show_default=False)],
    images: Images = None,
    more_images: MoreImages = None,
    camera_format: CamerasFormat = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Read cameras and write them as JSON, camera-to-world with OpenCV axes, pixels with centres at .5.

    --images are needed where the format does not name the images, or does not tell their size.
    """
    from ..cameras.formats.transforms import FILE_NAME
    from ..cameras.io import detect_format, read_cameras, write_cameras
    from ..images.finding import find_images
    from .input_files import camera_files, given_images

    _check_name(out)
    given = [*(images or []), *(more_images or [])]
    outputs().reads("the cameras", camera_files(cameras))
    outputs().reads("an image", given_images(given))
    outputs().writes("", [out])
    found = read_cameras(cameras, find_images(given) if given else (), camera_format)
    write_cameras(out, found)
    ranges = sum(camera.depth_range is not None for camera in found)
    if ranges and out.name == FILE_NAME:
        note(f"note: a {FILE_NAME} does not hold depth ranges; those of {ranges} cameras were left out")
    note(f"read {len(found)} cameras as {camera_format or detect_format(cameras)}: {_lenses(found)}")
    say(f"wrote {out}")


def main() -> None:
    """Run the command."""
    run(app)


def _check_name(out: Path) -> None:
    if out.suffix != ".json":
        raise InputError(f"{out}: expected a file that ends in .json")


def _lenses(cameras: "Sequence[Camera]") -> str:
    """How many cameras have which size, focal length and lens."""
    kinds = Counter(
        f"{camera.width} x {camera.height}, focal length {camera.K[0, 0]:.1f}, "
        + ("fisheye" if camera.fisheye else "no distortion" if camera.distortion is None else "distorted")
        for camera in cameras
    )
    shown = [f"{count} of {kind}" for kind, count in kinds.most_common(3)]
    return "; ".join([*shown, "..."] if len(kinds) > len(shown) else shown)
