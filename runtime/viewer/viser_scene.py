"""A scene, the cameras and their photographs in viser's browser page, served or as one file (extra `view`).

The page has a frame of its own, in which lengths suit its half-precision covariances, clipping planes and controls:
the world's axes, the origin where the page's camera starts, and `DISTANCE` from there to what it looks at.
"""

import contextlib
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..geometry.quaternions import matrices_to_quaternions, quaternions_to_matrices
from ..images.colormaps import to_uint8
from ..rendering.cameras import focus_depth, overview_camera
from ..splats.gaussians import Gaussians
from .server import free_port, only_own_page

if TYPE_CHECKING:
    import viser

INSTALL = 'pip install "idesplat[view]"'
LOOPBACK = "127.0.0.1"
DISTANCE = 10.0
LARGEST_SCALE = 200.0  # whose square half precision still holds
SIZE = (720, 1280)  # of the view of a scene without cameras: height and width
FRUSTUM_DEPTH = 0.4  # from a camera to its photograph
# Within this nothing is shown, so that the first camera's photograph and its neighbours' do not hide what it saw.
NEAR = 1.0
PHOTOGRAPH_SIDE = 512  # pixels, of the longer side
LINE = 0.005
# Chromium runs no module worker from a blob of a page that was opened as a file, and viser 1.1 sorts its splats in one.
# Where such a worker cannot be made at all, viser's page makes it from a data address instead, and that one runs.
WORKERS_IN_FILES = """<script>
window.Worker = class extends Worker {
  constructor(url, options) {
    if (String(url).startsWith("blob:null")) throw new Error("no workers from blobs in files");
    super(url, options);
  }
};
</script>"""


class Viewpoint(NamedTuple):
    """A camera without distortion, and what it took, uint8 RGB [height, width, 3], if that is to be shown."""

    camera: Camera
    photograph: np.ndarray | None


@contextlib.contextmanager
def serving(
    gaussians: Gaussians, viewpoints: Sequence[Viewpoint], host: str, port: int
) -> Iterator["viser.ViserServer"]:
    """A server of the page for as long as the block runs; port 0 for any that is free, else `port` or the next free.

    No other page may connect (see `serving`). The page starts at the first viewpoint or, without any, where the whole
    scene is seen. A click at another viewpoint leads there.
    Raises InputError if viser is not installed, the place cannot be served at, or there is nothing to see.
    """
    first = viewpoints[0].camera if viewpoints else overview_camera(gaussians, *SIZE)
    unit = DISTANCE / focus_depth(gaussians, first)
    server = _start(host, port)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        _place_camera(server, first, [view.camera for view in viewpoints] or [first])
        if viewpoints:
            server.initial_camera.near = NEAR
        _add_gaussians(server, gaussians, first.extrinsics[:3, 3], unit)
        _add_viewpoints(server, [_moved(view, first.extrinsics[:3, 3], unit) for view in viewpoints])
        yield server
    finally:
        with _quiet():
            server.stop()


def standalone_page(gaussians: Gaussians, viewpoints: Sequence[Viewpoint]) -> str:
    """The page with everything in it as one HTML document, which needs no server and no network.

    It holds the Gaussians at 32 bytes each, compressed, in base64, and viser's own page, 0.8 MB.
    Raises InputError as `serving` does.
    """
    with serving(gaussians, viewpoints, LOOPBACK, 0) as server:
        page = server.get_scene_serializer().as_html()
    return page.replace("<head>", f"<head>{WORKERS_IN_FILES}", 1)


def _start(host: str, port: int) -> "viser.ViserServer":
    try:
        import viser
    except ImportError:
        raise InputError(f"looking at scenes needs viser, which is not installed: {INSTALL}") from None
    port = free_port(host, port)
    with _quiet(), only_own_page(host):
        return viser.ViserServer(host, port, verbose=False)


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Without viser's banner and farewell."""
    return contextlib.redirect_stdout(io.StringIO())


def _place_camera(server: "viser.ViserServer", first: Camera, cameras: Sequence[Camera]) -> None:
    """Let the page begin with what the first camera sees, and turn about the axis that points up in all of them."""
    right, forward = first.extrinsics[:3, 0], first.extrinsics[:3, 2]
    up = -np.mean([camera.extrinsics[:3, 1] for camera in cameras], axis=0)
    if np.linalg.norm(up) < 0.1:  # cameras that stand on their heads beside others that do not
        up = -first.extrinsics[:3, 1]
    server.scene.set_up_direction(up)
    start = server.initial_camera
    start.position = np.zeros(3)
    start.look_at = DISTANCE * forward
    # of all directions that leave the first camera's picture upright, the one nearest to the common one
    start.up = up - (up @ right) * right
    if start.up @ first.extrinsics[:3, 1] >= 0:
        start.up = -first.extrinsics[:3, 1]
    start.fov = _field_of_view(first)


def _add_gaussians(server: "viser.ViserServer", gaussians: Gaussians, origin: np.ndarray, unit: float) -> None:
    """Without the part of their colours that changes with the direction, which the page cannot show."""
    axes = quaternions_to_matrices(gaussians.quats) * np.minimum(unit * gaussians.scales, LARGEST_SCALE)[:, None]
    server.scene.add_gaussian_splats(
        "/Gaussians",
        centers=unit * (gaussians.means - origin),
        covariances=axes @ axes.transpose(0, 2, 1),
        rgbs=to_uint8(gaussians.colours),
        opacities=to_uint8(gaussians.opacities)[:, None],
    )


def _moved(view: Viewpoint, origin: np.ndarray, unit: float) -> Viewpoint:
    """The viewpoint in the page's frame."""
    extrinsics = view.camera.extrinsics.copy()
    extrinsics[:3, 3] = unit * (extrinsics[:3, 3] - origin)
    return view._replace(camera=replace(view.camera, extrinsics=extrinsics))


def _add_viewpoints(server: "viser.ViserServer", viewpoints: Sequence[Viewpoint]) -> None:
    """Frusta, with photographs where there are any; a click at one leads the page's camera there."""
    cameras = [view.camera for view in viewpoints]
    for index, view in enumerate(viewpoints):
        _add_frustum(server, index, view).on_click(partial(_stand_there, view.camera, cameras))


def _add_frustum(server: "viser.ViserServer", index: int, view: Viewpoint) -> "viser.CameraFrustumHandle":
    camera, photograph = view
    fov = _field_of_view(camera)
    aspect = camera.width / camera.K[0, 0] * camera.K[1, 1] / camera.height
    if photograph is not None:
        factor = min(1, PHOTOGRAPH_SIDE / max(photograph.shape[:2]))
        photograph = cv2.resize(photograph, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # viser's scale is that of a pyramid of volume 4 / 9, whatever its angles
    scale = FRUSTUM_DEPTH * float(np.cbrt(math.tan(fov / 2) ** 2 * aspect / 3))
    return server.scene.add_camera_frustum(
        f"/photographs/{index} {PurePosixPath(camera.name).name}",
        fov,
        aspect,
        scale=scale,
        thickness=LINE,
        image=photograph,
        wxyz=matrices_to_quaternions(camera.extrinsics[None, :3, :3])[0],
        position=camera.extrinsics[:3, 3],
        cast_shadow=False,
        receive_shadow=False,
    )


def _stand_there(clicked: Camera, cameras: Sequence[Camera], click: "viser.SceneNodePointerEvent") -> None:
    """Move the page's camera to the one that was clicked at.

    viser takes the first on the pointer's way, which may be the unseen one that the page's camera stands at.
    """
    start, direction = np.array(click.ray_origin), np.array(click.ray_direction)
    distances = [_distance(camera, start, direction) for camera in cameras]
    met = [index for index, distance in enumerate(distances) if distance > NEAR]
    if not met and np.linalg.norm(start - clicked.extrinsics[:3, 3]) <= NEAR:
        return
    camera = cameras[min(met, key=distances.__getitem__)] if met else clicked
    rotation, position = camera.extrinsics[:3, :3], camera.extrinsics[:3, 3]
    with click.client.atomic():
        page = click.client.camera
        page.position = position
        page.wxyz = matrices_to_quaternions(rotation[None])[0]
        page.look_at = position + DISTANCE * rotation[:, 2]
        page.fov = _field_of_view(camera)


def _distance(camera: Camera, start: np.ndarray, direction: np.ndarray) -> float:
    """How far along a ray, from `start` [3] in a `direction` [3], a camera's photograph is; NaN if it is not met."""
    rotation, position = camera.extrinsics[:3, :3], camera.extrinsics[:3, 3]
    start, direction = (start - position) @ rotation, direction @ rotation  # in the camera's frame
    distance = (FRUSTUM_DEPTH - start[2]) / direction[2] if direction[2] else math.nan
    x, y = np.diag(camera.K)[:2] * (start + distance * direction)[:2] / FRUSTUM_DEPTH  # pixels from the middle
    return distance if abs(x) <= camera.width / 2 and abs(y) <= camera.height / 2 else math.nan


def _field_of_view(camera: Camera) -> float:
    """From top to bottom, in radians, as if the principal point were in the middle."""
    return 2 * math.atan(camera.height / 2 / camera.K[1, 1])
