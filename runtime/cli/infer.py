"""The command `idesplat infer`: photographs to a splat file, depth maps and rendered views."""

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..cameras.formats import ESTIMATE
from ..errors import InputError
from ..inference.depth_format import DepthFormat
from ..system.output_names import SPLATS
from ..views.exposure_mode import ExposureMode
from .interrupting import StopOnInterrupt
from .options import (
    CamerasFormat,
    CloseHoles,
    Config,
    Crop,
    CropBorder,
    DepthJump,
    Device,
    Exposure,
    Far,
    Focal,
    Images,
    Json,
    MaxGaussians,
    MergeDuplicates,
    MinConsistency,
    MinOpacity,
    Model,
    Near,
    Offset,
    Overwrite,
    Provider,
    ProviderOption,
    QualityOption,
    Quiet,
    Refine,
    RemoveContradicted,
    Select,
    Size,
    Threads,
    Verbose,
    Views,
)
from .outputs import command
from .reporting import note
from .session_options import session_config
from .terminal import run, say

if TYPE_CHECKING:
    from ..cameras.discovery import Found
    from ..reconstruction.result import Reconstruction
    from .infer_outputs import Targets

OUT_HELP = (
    "Splats: .ply, .compressed.ply, .splat, .spz, .sog, .glb. Points: .points.ply, .points.glb, .xyz, .obj. "
    "Surfaces: .mesh.ply, .mesh.glb, .mesh.obj. Else a .ply in the current folder, named after the folder of the "
    "photographs."
)


@command("idesplat infer")
def infer(
    *,
    photos: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PHOTOS",
            help="Folder, glob or files of photographs, or a video; else the images that the cameras name.",
            show_default=False,
        ),
    ] = None,
    images: Images = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras",
            "-c",
            help="File or folder of cameras (transforms.json, COLMAP, RealEstate10K, LLFF, DTU, OpenCV stereo, our own "
            "JSON), or `estimate` to find them from the photographs. Else those beside the photographs, estimated "
            "where there are none.",
            metavar="PATH|estimate",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=OUT_HELP, show_default=False)] = None,
    model: Model = None,
    camera_format: CamerasFormat = None,
    focal: Focal = None,
    quality: QualityOption = None,
    views: Views = None,
    select: Select = None,
    size: Size = None,
    crop: Crop = False,
    refine: Refine = None,
    max_gaussians: MaxGaussians = 0,
    near: Near = None,
    far: Far = None,
    offset: Offset = None,
    exposure: Exposure = ExposureMode.AUTO,
    provider: Provider = "CPU",
    provider_option: ProviderOption = None,
    device: Device = None,
    threads: Threads = None,
    save_depth: Annotated[Path | None, typer.Option(help="Folder for depth maps with their cameras.")] = None,
    depth_format: Annotated[
        DepthFormat | None,
        typer.Option(help="Of --save-depth: .png and metric .npz (default), or a dense workspace of COLMAP."),
    ] = None,
    render: Annotated[Path | None, typer.Option(help="Folder for views rendered from the result.")] = None,
    min_opacity: MinOpacity = 0,
    crop_border: CropBorder = 0,
    max_depth_jump: DepthJump = 0,
    min_consistency: MinConsistency = 0,
    remove_contradicted: RemoveContradicted = False,
    merge_duplicates: MergeDuplicates = False,
    close_holes: CloseHoles = False,
    save_cameras: Annotated[
        Path | None,
        typer.Option(
            help="Write the cameras of the images: our own JSON, or transforms.json if named so. Estimated ones are "
            "kept in any case, beside the scene."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write one .html that shows views, depth, consistency, timings and settings.")
    ] = None,
    timings: Annotated[bool, typer.Option("--timings", help="Print seconds by stage.")] = False,
    json_path: Json = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Turn photographs into a 3D Gaussian splat that every viewer opens.

    `idesplat infer FOLDER` is enough: cameras are looked for beside the photographs, or else estimated.
    """
    from ..images.sizes import parse_size
    from ..inference.inputs import parse_views
    from ..inference.model_files import read_model
    from ..inference.named_models import find_model
    from ..reconstruction.pipeline import reconstruct
    from ..splats.filtering import FilterOptions
    from ..splats.io import is_mesh
    from .infer_outputs import Targets

    started = time.perf_counter()
    session = session_config(threads, device, provider_option)
    given = [*(images or []), *(photos or [])]
    found = _find_cameras(given, cameras)
    if focal and found.cameras is not None:
        raise InputError(
            f"--focal {focal}: is for estimated cameras, and those of {found.cameras} are used; leave it out"
        )
    if crop and size:
        raise InputError("--crop and --size: both give the size to work at; leave one of them out")
    targets = Targets(
        out or _named_after(given), save_depth, depth_format, render, save_cameras, report, json_path, found
    )
    model = find_model(model)
    targets.announce(model)
    filters = FilterOptions(
        min_opacity=min_opacity,
        crop_border=crop_border,
        max_depth_jump=max_depth_jump,
        min_consistency=min_consistency,
        remove_contradicted=remove_contradicted,
        merge_duplicates=merge_duplicates,
        close_holes=close_holes,
    )
    files = read_model(model)
    targets.check_model(files, filters, refine, max_gaussians)
    surface = is_mesh(targets.out)
    with StopOnInterrupt() as on_step:
        result = reconstruct(
            given,
            cameras,
            model=files,
            camera_format=camera_format,
            focal=focal,
            select=select,
            views=parse_views(views) if views else None,
            size=parse_size(size) if size else None,
            crop=crop,
            quality=quality,
            refine="0" if surface else refine,
            max_gaussians=0 if surface else max_gaussians,
            near=near,
            far=far,
            offset=offset,
            exposure=exposure,
            provider=provider,
            session=session,
            filters=FilterOptions() if surface else filters,
            on_inputs=targets.announce_views,
            on_step=on_step,
        )
    if on_step.stopped:
        note(f"refinement stopped after {len(result.psnr)} steps")
    seconds = targets.write(result, filters, started)
    _tell(result, targets, seconds, camera_format)
    if timings:
        say(*(f"{name:>10} {value:8.2f} s" for name, value in seconds.items()))


def main() -> None:
    """Run the command."""
    run(infer)


def _find_cameras(images: list[Path], cameras: str | None) -> "Found":
    """The images to read and their cameras' path: given, found beside the images, or None."""
    from ..cameras.discovery import Found, find_cameras

    if cameras is None and not images:
        raise InputError("PHOTOS: none given; give a folder, a glob, files or a video, or --cameras that name them")
    if cameras is None:
        return find_cameras(images)
    return Found(images, None if cameras == ESTIMATE else Path(cameras), "")


def _named_after(images: list[Path]) -> Path:
    """The file of splats in the current folder that is named after the folder of the images, or the video."""
    if not images:
        raise InputError("--out: expected the file to write, such as scene.ply, where --cameras name the images")
    from ..images.finding import first_match, is_video

    first = first_match(images[0])
    if not first.is_dir() and is_video(first):
        return Path(first.stem + SPLATS)
    folder = first if first.is_dir() else first.parent
    return Path((folder.resolve().name or "scene") + SPLATS)


def _tell(result: "Reconstruction", targets: "Targets", seconds: dict[str, float], camera_format: str | None) -> None:
    """Print what was chosen and written, and the commands that show it."""
    from ..splats.io import holds_splats

    span = result.depth_range
    note(*result.notes)
    note(f"near {span.near:.4g} and far {span.far:.4g}, in the cameras' unit: {span.source}")
    targets.tell_written(result, seconds)
    if result.gaussians is not None and holds_splats(targets.out):
        cameras = targets.cameras_to_show(camera_format)
        images = targets.found.images
        shown = ["--images", str(images[0])] if len(images) == 1 else []
        note(f"open {targets.out} in any splat viewer (SuperSplat, for one), look at it in the browser, or render it:")
        note("    " + shlex.join(["idesplat", "view", str(targets.out), *cameras, *shown]))
        note("    " + shlex.join(["idesplat", "render", str(targets.out), *cameras, "--out"]) + " DIR")
    else:
        note(f"open {targets.out} in MeshLab, CloudCompare or Blender")
    if targets.report is not None:
        note(f"open {targets.report} in any browser")
