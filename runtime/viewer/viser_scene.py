"""A scene, the cameras and their images in viser's browser page, served or as one file (extra `view`).

The page's frame has the world's axes, its origin at the first camera, and a scale in which what that camera looks at is
`DISTANCE` away: lengths that suit viser's half-precision covariances, clipping planes and controls.
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
LARGEST_SCALE = 200.0  # whose square is still finite in half precision
SIZE = (720, 1280)  # height and width of the overview of a scene without cameras
FRUSTUM_DEPTH = 0.4  # from a camera to its image
# The near plane: the images of the first camera and its neighbours must not hide the scene.
NEAR = 1.0
IMAGE_SIDE = 512  # pixels, of the longer side
LINE = 0.005
# Chromium does not run module workers from blobs in pages opened as files, and viser 1.1 sorts its splats in one. If
# the constructor of such a worker throws, viser's page creates it from a data URL instead, which works.
WORKERS_IN_FILES = """<script>
window.Worker = class extends Worker {
  constructor(url, options) {
    if (String(url).startsWith("blob:null")) throw new Error("no workers from blobs in files");
    super(url, options);
  }
};
</script>"""


class Viewpoint(NamedTuple):
    """A camera without distortion, and its image, uint8 RGB [height, width, 3], if it is to be shown."""

    camera: Camera
    image: np.ndarray | None


@contextlib.contextmanager
def serving(
    gaussians: Gaussians, viewpoints: Sequence[Viewpoint], host: str, port: int
) -> Iterator["viser.ViserServer"]:
    """A server of the page while the block runs; port 0 for any that is free, else `port` or the next free one.

    Other pages cannot connect (`server.only_own_page`). The page starts at the first viewpoint or, without any, at an
    overview of the scene. A click on a viewpoint moves the camera there.
    Raises InputError if viser is not installed, host or port cannot be used, or there is nothing to see.
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
        _add_viewpoints(server, [_to_page_frame(view, first.extrinsics[:3, 3], unit) for view in viewpoints])
        yield server
    finally:
        with _quiet():
            server.stop()


def standalone_page(gaussians: Gaussians, viewpoints: Sequence[Viewpoint]) -> str:
    """The page and the scene as one HTML document, which needs no server and no network.

    It holds the Gaussians with 32 bytes each, compressed, in base64, and viser's own page, 0.8 MB.
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
    """Suppress what viser prints."""
    return contextlib.redirect_stdout(io.StringIO())


def _place_camera(server: "viser.ViserServer", first: Camera, cameras: Sequence[Camera]) -> None:
    """Start the page at the first camera, with the mean up direction of the cameras as its orbit axis."""
    right, forward = first.extrinsics[:3, 0], first.extrinsics[:3, 2]
    up = -np.mean([camera.extrinsics[:3, 1] for camera in cameras], axis=0)
    if np.linalg.norm(up) < 0.1:  # some cameras are upside down
        up = -first.extrinsics[:3, 1]
    server.scene.set_up_direction(up)
    start = server.initial_camera
    start.position = np.zeros(3)
    start.look_at = DISTANCE * forward
    # the direction nearest to `up` among those that keep the first camera's image upright
    start.up = up - (up @ right) * right
    if start.up @ first.extrinsics[:3, 1] >= 0:
        start.up = -first.extrinsics[:3, 1]
    start.fov = _field_of_view(first)


def _add_gaussians(server: "viser.ViserServer", gaussians: Gaussians, origin: np.ndarray, unit: float) -> None:
    """Add the Gaussians with the colours of SH degree 0: viser does not show view-dependent colour."""
    axes = quaternions_to_matrices(gaussians.quats) * np.minimum(unit * gaussians.scales, LARGEST_SCALE)[:, None]
    server.scene.add_gaussian_splats(
        "/Gaussians",
        centers=unit * (gaussians.means - origin),
        covariances=axes @ axes.transpose(0, 2, 1),
        rgbs=to_uint8(gaussians.colours),
        opacities=to_uint8(gaussians.opacities)[:, None],
    )


def _to_page_frame(view: Viewpoint, origin: np.ndarray, unit: float) -> Viewpoint:
    """The viewpoint in the page's frame."""
    extrinsics = view.camera.extrinsics.copy()
    extrinsics[:3, 3] = unit * (extrinsics[:3, 3] - origin)
    return view._replace(camera=replace(view.camera, extrinsics=extrinsics))


def _add_viewpoints(server: "viser.ViserServer", viewpoints: Sequence[Viewpoint]) -> None:
    """Add frusta, with images where there are any; a click on one moves the page's camera there."""
    cameras = [view.camera for view in viewpoints]
    for index, view in enumerate(viewpoints):
        _add_frustum(server, index, view).on_click(partial(_move_to, view.camera, cameras))


def _add_frustum(server: "viser.ViserServer", index: int, view: Viewpoint) -> "viser.CameraFrustumHandle":
    camera, image = view
    fov = _field_of_view(camera)
    aspect = camera.width / camera.K[0, 0] * camera.K[1, 1] / camera.height
    if image is not None:
        factor = min(1, IMAGE_SIDE / max(image.shape[:2]))
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # viser scales a pyramid of volume 4 / 9, whatever its angles
    scale = FRUSTUM_DEPTH * float(np.cbrt(math.tan(fov / 2) ** 2 * aspect / 3))
    return server.scene.add_camera_frustum(
        f"/images/{index} {PurePosixPath(camera.name).name}",
        fov,
        aspect,
        scale=scale,
        thickness=LINE,
        image=image,
        wxyz=matrices_to_quaternions(camera.extrinsics[None, :3, :3])[0],
        position=camera.extrinsics[:3, 3],
        cast_shadow=False,
        receive_shadow=False,
    )


def _move_to(clicked: Camera, cameras: Sequence[Camera], click: "viser.SceneNodePointerEvent") -> None:
    """Move the page's camera to the viewpoint that was clicked.

    viser picks the first along the ray, which may be the hidden one at the page's own camera.
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
    """Distance along a ray, from `start` [3] in `direction` [3], to a camera's image; NaN if the ray misses it."""
    rotation, position = camera.extrinsics[:3, :3], camera.extrinsics[:3, 3]
    start, direction = (start - position) @ rotation, direction @ rotation  # in the camera's frame
    distance = (FRUSTUM_DEPTH - start[2]) / direction[2] if direction[2] else math.nan
    x, y = np.diag(camera.K)[:2] * (start + distance * direction)[:2] / FRUSTUM_DEPTH  # pixels from the middle
    return distance if abs(x) <= camera.width / 2 and abs(y) <= camera.height / 2 else math.nan


def _field_of_view(camera: Camera) -> float:
    """Vertical field of view in radians, for a principal point in the middle."""
    return 2 * math.atan(camera.height / 2 / camera.K[1, 1])
