"""The command `idesplat view`: a splat file in a browser, served on this machine or as one file to send."""

import contextlib
import webbrowser
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..cameras.io import CameraFormat
from ..errors import InputError, Terminated
from ..system.outputs import outputs
from .options import Cameras, CamerasFormat, Config, Host, Images, MoreImages, Overwrite, Port, Quiet, Verbose
from .outputs import command
from .terminal import run, say

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..viewer.viser_scene import Viewpoint

LOOPBACK = "127.0.0.1"
PORT = 8080


@command("idesplat view")
def view(
    scene: Annotated[Path, typer.Argument(help="Splat file of any format.", show_default=False)],
    cameras: Cameras = None,
    camera_format: CamerasFormat = None,
    images: Images = None,
    more_images: MoreImages = None,
    html: Annotated[
        Path | None, typer.Option(help="Write one .html that opens anywhere, without network, instead of serving.")
    ] = None,
    host: Host = LOOPBACK,
    port: Port = PORT,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    overwrite: Overwrite = False,
    config: Config = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
) -> None:
    """Look at a splat file in the browser, from the first camera, with the cameras and their images around it.

    With --images only the cameras of these images are shown. A click at a camera leads there (not in an .html).
    Nothing is fetched from the network.
    """
    from ..splats.io import read_splats

    if images and cameras is None:
        raise InputError("--images: needs the cameras that took them; give --cameras")
    if html is not None:
        _check_page(html, scene, cameras, [*(images or []), *(more_images or [])])
    gaussians = read_splats(scene)
    viewpoints = read_viewpoints(cameras, camera_format, [*(images or []), *(more_images or [])])
    viewpoints = _relative(viewpoints, scene)
    if html is None:
        from ..viewer.server import address
        from ..viewer.viser_scene import serving

        with serving(gaussians, viewpoints, host, port) as server, _until_interrupted():
            page = address(host, server.get_port())
            click = "a click at a camera leads there, " if viewpoints else ""
            say(f"{len(gaussians):,} Gaussians to look at: {page} ({click}stop with Ctrl-C)")
            if browser:
                webbrowser.open(page)
            server.sleep_forever()
        return
    from ..system.files import atomic_write
    from ..system.progress import working
    from ..viewer.viser_scene import standalone_page

    with working("making the page"):
        page = standalone_page(gaussians, viewpoints)
    with atomic_write(html) as temporary:
        temporary.write_text(page, encoding="utf-8")
    say(f"wrote {html}: {len(gaussians):,} Gaussians, {html.stat().st_size / 1e6:.1f} MB; open it in any browser")


def main() -> None:
    """Run the command."""
    run(view)


@contextlib.contextmanager
def _until_interrupted() -> Iterator[None]:
    """Exit with status 0 on Ctrl-C, which ends this command; other signals are errors."""
    try:
        yield
    except Terminated:
        raise
    except KeyboardInterrupt:
        return


def _check_page(html: Path, scene: Path, cameras: Path | None, images: list[Path]) -> None:
    """Check before the work that the page can be written and is none of the inputs."""
    from .input_files import camera_files, given_images

    if html.suffix.lower() not in (".html", ".htm") or html.is_dir():
        raise InputError(f"--html {html}: expected a file to write, whose name ends in .html")
    run = outputs()
    run.reads("the scene", [scene])
    run.reads("the cameras", camera_files(cameras) if cameras else [])
    run.reads("an image", given_images(images))
    run.writes("--html", [html])


def _relative(viewpoints: "list[Viewpoint]", scene: Path) -> "list[Viewpoint]":
    """The viewpoints in the world of a scene that was written relative to an offset."""
    from ..cameras.camera import offset_cameras
    from ..splats.io import read_offset

    cameras = offset_cameras([viewpoint.camera for viewpoint in viewpoints], read_offset(scene))
    return [viewpoint._replace(camera=camera) for viewpoint, camera in zip(viewpoints, cameras, strict=True)]


def read_viewpoints(cameras: Path | None, form: CameraFormat | None, images: list[Path]) -> "list[Viewpoint]":
    """Undistorted images with their cameras; all cameras if no images are given.

    Raises InputError for unreadable files, or images and cameras that do not match.
    """
    from ..cameras.io import read_cameras
    from ..system.files import scratch_folder
    from ..system.progress import progress
    from ..viewer.viser_scene import Viewpoint
    from ..views.batch import match_images_to_cameras
    from ..views.sources import find_input_images
    from .input_files import with_cameras

    if cameras is None:
        return []
    if not images:
        return [
            Viewpoint(replace(camera, distortion=None, fisheye=False), None)
            for camera in read_cameras(cameras, camera_format=form)
        ]
    with scratch_folder() as folder:
        files = find_input_images(images, cameras, form, folder)
        every = read_cameras(cameras, files, form)
        pairs = match_images_to_cameras(with_cameras(files, every), every)
        return [_viewpoint(file, camera) for file, camera in progress(pairs, "reading images")]


def _viewpoint(file: Path, camera: "Camera") -> "Viewpoint":
    """A camera with its image, both undistorted."""
    from ..cameras.camera import resize_camera
    from ..cameras.undistortion import undistort
    from ..errors import error_context
    from ..images.io import load_image
    from ..viewer.viser_scene import Viewpoint

    image = load_image(file)
    with error_context(str(file)):
        camera = resize_camera(camera, image.shape[1], image.shape[0])
    image, camera = undistort(image, camera)
    return Viewpoint(camera, image)
