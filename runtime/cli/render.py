"""The command `idesplat render`: a splat file to images or a video."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ..cameras.camera import Camera, offset_cameras
from ..cameras.io import read_cameras
from ..errors import InputError
from ..images.colormaps import colormap_depth, inverse_depth_range
from ..images.finding import SUFFIXES, VIDEO_SUFFIXES
from ..images.naming import name_files
from ..images.png import save_png
from ..images.sizes import parse_size
from ..images.video_writer import check_video_support, open_video
from ..rendering.cameras import (
    CAMERA_ORBIT_DEG,
    MAX_FRAMES,
    OVERVIEW_NAME,
    SCENE_ORBIT_DEG,
    check_image_sizes,
    fit_camera,
    orbit_cameras,
    overview_camera,
    path_cameras,
)
from ..rendering.rasterizer import MAX_LENS
from ..rendering.render import AUTO, SOLID, autofocus, render_view
from ..rendering.types import Rendering
from ..splats.gaussians import Gaussians
from ..splats.io import read_offset, read_splats
from ..system.files import atomic_write
from ..system.output_names import ALPHA, ARRAYS, DEPTH, IMAGE, VIDEO, frame_names, kind_file
from ..system.outputs import outputs
from ..system.progress import progress
from .input_files import camera_files, named_images, nearby_images
from .options import Cameras, CamerasFormat, Config, Overwrite, Quiet, Verbose, parse_count
from .outputs import command
from .reporting import note
from .terminal import run, say

COMMAND = "idesplat render"
COLOUR = ""  # beside DEPTH and ALPHA: the endings of the names of the kinds of images
FRAMES, FPS = 90, 30.0  # by default
SIZE = "360x640"  # without cameras and --size
MOST_LISTED = 12  # files that are named one by one


@command(COMMAND)
def render(
    scene: Annotated[Path, typer.Argument(help="Splat file of any format.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for images, one .png, or one .mp4.", show_default=False)
    ],
    cameras: Cameras = None,
    camera_format: CamerasFormat = None,
    orbit: Annotated[bool, typer.Option("--orbit", help="Go around the scene.")] = False,
    path: Annotated[bool, typer.Option("--path", help="Go smoothly through the cameras.")] = False,
    degrees: Annotated[
        float | None, typer.Option(help="Of the orbit: 360 by default, with cameras a swing of 30.", show_default=False)
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            help=f"How many images --orbit and --path make, 1 to {MAX_FRAMES}; {FRAMES} by default.",
            parser=parse_count,
            metavar="INTEGER",
            show_default=False,
        ),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help=f"Frames a second of an .mp4; {FPS} by default.", show_default=False)
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help=f"HEIGHTxWIDTH to render at; else the cameras' sizes, or {SIZE}.", show_default=False),
    ] = None,
    depth: Annotated[
        bool, typer.Option("--depth", help="Render depth, too (colours; of images also metric .npz).")
    ] = False,
    alpha: Annotated[bool, typer.Option("--alpha", help="Render opacity, too.")] = False,
    background: Annotated[
        str, typer.Option(help="Red, green and blue behind the scene, 0 to 1, such as 1,1,1.", metavar="R,G,B")
    ] = "0,0,0",
    aperture: Annotated[
        float | None,
        typer.Option(
            help="Diameter in scene units of a lens that blurs what is out of focus; a pinhole where not given.",
            metavar="DIAMETER",
        ),
    ] = None,
    focus: Annotated[
        str | None,
        typer.Option(
            help="Depth in scene units that --aperture leaves sharp, or auto: what the first image has in its middle.",
            metavar="DISTANCE|auto",
            show_default=AUTO,
        ),
    ] = None,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Render a splat file from cameras, on a path through them, in an orbit, or from an overview camera.

    Images are named after the cameras' images and have the cameras' own size. They are without lens distortion: where
    a camera has it, compare with the undistorted image.
    """
    colour = _parse_background(background)
    lens = _parse_lens(aperture, focus)
    if out.suffix.lower() == IMAGE:
        out = out.with_suffix(IMAGE)
    _check_out(out)
    if frames is not None and not (orbit or path):
        raise InputError(f"--frames {frames}: is of --orbit and --path; add one of them")
    if fps is not None and out.suffix.lower() != VIDEO:
        raise InputError(f"--fps {fps:g}: is of a video; give an --out that ends in {VIDEO}")
    if camera_format is not None and cameras is None:
        raise InputError(f"--camera-format {camera_format}: is of --cameras; add it")
    frames, fps = FRAMES if frames is None else frames, FPS if fps is None else fps
    if not 1 <= fps <= 1000:
        raise InputError(f"--fps {fps:g}: expected frames a second, 1 to 1000")
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f"--frames {frames}: expected 1 to {MAX_FRAMES} images")
    if path and orbit:
        raise InputError("--path and --orbit: expected one of them")
    if degrees is not None and not orbit:
        raise InputError(f"--degrees {degrees:g}: is of the orbit; add --orbit")
    views = read_cameras(cameras, camera_format=camera_format) if cameras else []
    if path and not views:
        raise InputError("--path: needs the cameras that it leads through; give --cameras, or use --orbit")
    kinds = [COLOUR, *[DEPTH] * depth, *[ALPHA] * alpha]
    names = frame_names(frames) if path or orbit else [view.name for view in views] or [OVERVIEW_NAME]
    stems = _stems(names, out, kinds)
    _announce(scene, cameras, views, stems, out, kinds)
    gaussians = read_splats(scene)
    views = offset_cameras(views, read_offset(scene))
    trajectory = _choose_cameras(gaussians, views, orbit, path, degrees, frames, size)
    check_image_sizes(trajectory)
    render_camera = _renderer(gaussians, colour, *_focus(lens, gaussians, trajectory[0]))
    if out.suffix.lower() == VIDEO:
        written = _save_video(render_camera, trajectory, out, fps, kinds)
    else:
        written = _save_images(render_camera, trajectory, stems, kinds)
    for file in written if len(written) <= MOST_LISTED else [f"{len(written)} files in {out}"]:
        say(f"wrote {file}")
    images = "1 image" if len(trajectory) == 1 else f"{len(trajectory)} images"
    say(f"{len(gaussians):,} Gaussians rendered in {images}; open {out} in any {_viewer(out)}")


def main() -> None:
    """Run the command."""
    run(render)


def _check_out(out: Path) -> None:
    """Raise InputError for an unsupported suffix, or for a video if PyAV is not installed."""
    if out.suffix.lower() in {*SUFFIXES, *VIDEO_SUFFIXES, ".gif"} - {IMAGE, VIDEO} and not out.is_dir():
        raise InputError(f"--out {out}: expected a folder, or a file that ends in {IMAGE} or {VIDEO}")
    if out.suffix.lower() == VIDEO:
        check_video_support()


def _parse_background(text: str) -> tuple[float, float, float]:
    """The option --background, `R,G,B` with numbers from 0 to 1; raises InputError."""
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = green = blue = float("nan")
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise InputError(f"--background {text}: expected red, green and blue from 0 to 1, such as 1,1,1")
    return red, green, blue


def _parse_lens(aperture: float | None, focus: str | None) -> tuple[float, float | None]:
    """The options --aperture and --focus, the latter None for auto; raises InputError."""
    if aperture is None:
        if focus is not None:
            raise InputError(f"--focus {focus}: needs a lens; give its diameter in scene units as --aperture")
        return 0.0, None
    if not 0 <= aperture <= MAX_LENS:
        raise InputError(f"--aperture {aperture:g}: expected the lens's diameter in scene units, 0 to {MAX_LENS:g}")
    if focus is None or focus == AUTO:
        return aperture, None
    try:
        distance = float(focus)
    except ValueError:
        distance = math.nan
    if not distance >= 1 / MAX_LENS:
        raise InputError(f"--focus {focus}: expected a distance in scene units above 0, or {AUTO}")
    return aperture, distance


def _announce(
    scene: Path, cameras: Path | None, views: Sequence[Camera], stems: Sequence[Path], out: Path, kinds: Sequence[str]
) -> None:
    """Register inputs and outputs; raises InputError if they conflict.

    The cameras' images are not read, but must not be replaced. Images rendered by this command do not count.
    """
    run = outputs()
    run.reads("the scene", [scene])
    if cameras is not None:
        run.reads("the cameras", camera_files(cameras))
        run.reads("an image", named_images(cameras, views))
        nearby = nearby_images(cameras, views)
        run.reads("an image", [image for image in nearby if run.writer_of(image) != COMMAND])
    if out.suffix.lower() == VIDEO:
        run.writes("--out", [_video_path(out, kind) for kind in kinds])
        return
    run.writes("--out", [_image_path(stem, kind) for stem in stems for kind in kinds])
    if DEPTH in kinds:
        run.writes("--out", [_metric_path(stem) for stem in stems])


def _video_path(out: Path, kind: str) -> Path:
    return kind_file(out.with_suffix(""), kind, out.suffix)


def _image_path(stem: Path, kind: str) -> Path:
    return kind_file(stem, kind, IMAGE)


def _metric_path(stem: Path) -> Path:
    """Path of the depth in world units."""
    return kind_file(stem, DEPTH, ARRAYS)


def _choose_cameras(
    gaussians: Gaussians,
    views: Sequence[Camera],
    orbit: bool,
    path: bool,
    degrees: float | None,
    frames: int,
    size: str | None,
) -> list[Camera]:
    """The cameras to render from."""
    if views and size:
        views = [fit_camera(view, *parse_size(size)) for view in views]
    if path:
        return path_cameras(views, frames)
    if orbit:
        centre = list(views) or [overview_camera(gaussians, *parse_size(size or SIZE))]
        if degrees is None:
            degrees = CAMERA_ORBIT_DEG if views else SCENE_ORBIT_DEG
        return orbit_cameras(gaussians, centre, degrees, frames)
    return list(views) or [overview_camera(gaussians, *parse_size(size or SIZE))]


def _focus(lens: tuple[float, float | None], gaussians: Gaussians, first: Camera) -> tuple[float, float | None]:
    """The aperture and the distance in focus, chosen with the first camera where None is given, and noted."""
    aperture, distance = lens
    if not aperture:
        return lens
    chosen = "" if distance is not None else f", the median depth in the middle of the first image ({first.name})"
    distance = autofocus(gaussians, first) if distance is None else distance
    farthest = aperture * first.K[0, 0] / distance
    note(f"in focus at {distance:.4g}{chosen}; what is far behind is blurred over {farthest:.3g} pixels")
    return aperture, distance


def _renderer(
    gaussians: Gaussians, background: tuple[float, float, float], aperture: float, focus: float | None
) -> Callable[[Camera], Rendering]:
    def render_camera(camera: Camera) -> Rendering:
        size = camera.width, camera.height
        return render_view(gaussians, camera.extrinsics, camera.K, *size, background, aperture, focus)

    return render_camera


def _save_video(
    render_camera: Callable[[Camera], Rendering],
    trajectory: Sequence[Camera],
    out: Path,
    fps: float,
    kinds: Sequence[str],
) -> list[Path]:
    """A video of each kind; the paths written."""
    width, height = trajectory[0].width, trajectory[0].height
    for camera in trajectory:
        if (camera.width, camera.height) != (width, height):
            raise InputError(
                f"--out {out}: {camera.name} has {camera.width}x{camera.height} pixels, {trajectory[0].name} "
                f"{width}x{height}, and a video has one size; add --size"
            )
    limits: tuple[float, float] | None = None  # the first frame's, so that colours mean the same in all
    with ExitStack() as stack:
        videos = {kind: _video_path(out, kind) for kind in kinds}
        add = {kind: stack.enter_context(open_video(video, width, height, fps)) for kind, video in videos.items()}
        for camera in progress(trajectory, "rendering"):
            rendering = render_camera(camera)
            limits = limits or inverse_depth_range(_depth(rendering))
            for kind in kinds:
                add[kind](_image(rendering, kind, limits))
    return list(videos.values())


def _save_images(
    render_camera: Callable[[Camera], Rendering],
    trajectory: Sequence[Camera],
    stems: Sequence[Path],
    kinds: Sequence[str],
) -> list[Path]:
    """An image of each kind for each camera, and metric depth; the paths written."""
    written = []
    for camera, stem in progress(list(zip(trajectory, stems, strict=True)), "rendering"):
        rendering = render_camera(camera)
        for kind in kinds:
            target = _image_path(stem, kind)
            save_png(target, _image(rendering, kind))
            written.append(target)
        if DEPTH in kinds:
            metric = _metric_path(stem)
            with atomic_write(metric) as temporary:
                np.savez_compressed(temporary, depth=_depth(rendering))
            written.append(metric)
    return written


def _depth(rendering: Rendering) -> np.ndarray:
    """Alpha-weighted mean depth in world units, 0 where alpha is below the threshold."""
    return np.where(rendering.alpha >= SOLID, rendering.depth / np.maximum(rendering.alpha, SOLID), 0).astype(
        np.float32
    )


def _image(rendering: Rendering, kind: str, limits: tuple[float, float] | None = None) -> np.ndarray:
    """One kind of image of a rendering, RGB in [0, 1], [height, width, 3]."""
    if kind == DEPTH:
        return colormap_depth(_depth(rendering), limits)
    return np.repeat(rendering.alpha[..., None], 3, axis=2) if kind == ALPHA else rendering.rgb


def _stems(names: Sequence[str], out: Path, kinds: Sequence[str]) -> list[Path]:
    """The images' paths without kind and suffix; raises InputError for several images and one file."""
    if out.suffix.lower() != IMAGE:
        return [out / name for name in name_files(names, kinds)]
    if len(names) > 1:
        raise InputError(f"--out {out}: {len(names)} images do not fit one file; give a folder or an .mp4")
    return [out.with_suffix("")]


def _viewer(out: Path) -> str:
    return "browser or video player" if out.suffix.lower() == VIDEO else "image viewer"
