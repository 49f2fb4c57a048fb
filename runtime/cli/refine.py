"""The command `idesplat refine`: a splat file fitted to the images of its scene."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..cameras.io import CameraFormat
from ..errors import InputError
from ..reconstruction.quality import MAX_STEPS, PRESETS, Quality
from .interrupting import StopOnInterrupt
from .options import Cameras, CamerasFormat, Config, Images, MaxGaussians, Overwrite, Quiet, Verbose
from .outputs import command, outputs
from .reporting import note
from .terminal import run, say

if TYPE_CHECKING:
    import numpy as np

    from ..cameras.camera import Camera
    from ..refinement.refine import PosedImage

STANDARD = PRESETS[Quality.STANDARD]
STEPS_HELP = (
    f"Steps of the optimiser, one image each; else {STANDARD.steps_per_added_view} for each image beyond the first."
)


@command("idesplat refine")
def refine(
    scene: Annotated[Path, typer.Argument(help="Splat file of any format.", show_default=False)],
    images: Images = None,
    cameras: Cameras = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Splat file to write, of any format.", show_default=False)
    ] = None,
    camera_format: CamerasFormat = None,
    steps: Annotated[
        int | None,
        typer.Option(
            help=STEPS_HELP,
            min=1,
            max=MAX_STEPS,
        ),
    ] = None,
    max_side: Annotated[int, typer.Option(help="Longer side of the images, in pixels.", min=16, max=4096)] = 512,
    seed: Annotated[int, typer.Option(help="Of the order of the images.", min=0)] = 0,
    max_gaussians: MaxGaussians = 0,
    refine_poses: Annotated[
        Path | None,
        typer.Option(
            help="Refine the poses of the cameras, too, and write the cameras to this .json file.", show_default=False
        ),
    ] = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Fit the Gaussians of a splat file to posed images of its scene.

    Parts of the images that the scene does not cover are left as they are.

    Ctrl-C ends the refinement and writes what it has reached.
    """
    from ..cameras.io import check_writable, write_cameras
    from ..refinement.options import POSE_LR, RefinementOptions
    from ..refinement.poses import refined_cameras
    from ..refinement.refine import refine as fit
    from ..splats.io import read_offset, read_splats, splat_suffix, write_splats
    from ..system.files import scratch_folder

    if cameras is None:
        raise InputError("--cameras: missing; give the cameras of the images")
    if out is None:
        raise InputError("--out: missing; give the splat file to write, such as refined.ply")
    splat_suffix(out)
    _protect_inputs(scene, cameras, images or [], out, refine_poses)
    gaussians, offset = read_splats(scene), read_offset(scene)
    with scratch_folder() as folder:
        found, views = _read_views(cameras, camera_format, images or [], offset, max_side, folder)
    if refine_poses:
        check_writable(refine_poses, found)
    options = RefinementOptions(
        steps or STANDARD.steps(len(views)),
        seed=seed,
        max_gaussians=max_gaussians,
        lr_poses=POSE_LR if refine_poses else 0,
    )
    with StopOnInterrupt() as on_step:
        refined = fit(gaussians, views, options, on_step)
    first, last = refined.mean_psnr()
    if math.isnan(first):
        raise InputError(f"{cameras}: none of {refined.steps} images shows the scene; give the cameras of its world")
    if on_step.stopped:
        note(f"stopped after {refined.steps} of {options.steps} steps")
    for line in write_splats(out, refined.gaussians, offset):
        note(f"note: {line}")
    if refine_poses:
        write_cameras(refine_poses, refined_cameras(found, refined.viewmats, offset))
    say(
        f"wrote {out}: {len(refined.gaussians):,} Gaussians, {refined.steps} steps on {len(views)} images, their PSNR "
        f"{first:.2f} dB in the first round and {last:.2f} dB in the last"
    )
    if refine_poses:
        say(f"wrote {refine_poses}: {len(found)} cameras with refined poses")


def main() -> None:
    """Run the command."""
    run(refine)


def _protect_inputs(scene: Path, cameras: Path, images: list[Path], out: Path, poses: Path | None) -> None:
    """Find out before the work whether the files can be written, and are none of the files to read."""
    from .input_files import camera_files, given_images

    outputs().reads("the scene", [scene])
    outputs().reads("the cameras", camera_files(cameras))
    outputs().reads("an image", given_images(images))
    outputs().writes("--out", [out])
    if poses:
        outputs().writes("--refine-poses", [poses])


def _read_views(
    cameras: Path, form: CameraFormat | None, images: list[Path], offset: "np.ndarray", max_side: int, folder: Path
) -> "tuple[list[Camera], list[PosedImage]]":
    """The images' cameras as given, and the images with their cameras in the scene's world.

    folder: for the frames of a video.
    """
    from ..cameras.camera import offset_cameras
    from ..cameras.io import read_cameras
    from ..refinement.views import load_posed_images
    from ..views.batch import match_images_to_cameras
    from ..views.sources import find_input_images
    from .input_files import with_cameras

    files = find_input_images(images, cameras, form, folder)
    every = read_cameras(cameras, files, form)
    pairs = match_images_to_cameras(with_cameras(files, every), every)
    found = [camera for _, camera in pairs]
    placed = zip(pairs, offset_cameras(found, offset), strict=True)
    return found, load_posed_images([(file, camera) for (file, _), camera in placed], max_side)
