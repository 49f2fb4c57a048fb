"""A scene, the cameras and their photographs in viser's browser page, served or as one file (extra `view`).

The page has a frame of its own, in which lengths suit its half-precision covariances, clipping planes and controls:
the world's axes, the origin where the page's camera starts, and `DISTANCE` from there to what it looks at.
"""

import contextlib
import io
import math
import socket
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from .cameras import Camera
from .errors import InputError
from .gaussians import Gaussians
from .images_out import to_bytes
from .quaternions import quaternions_from_matrices, rotation_matrices
from .shots import focus, overview

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
    """A server of the page for as long as the block runs; port 0 for any that is free.

    The page starts at the first viewpoint or, without any, where the whole scene is seen.
    Raises InputError if viser is not installed, the place cannot be served at, or there is nothing to see.
    """
    first = viewpoints[0].camera if viewpoints else overview(gaussians, *SIZE)
    unit = DISTANCE / focus(gaussians, first)
    server = _start(host, port)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        _place_camera(server, first, [view.camera for view in viewpoints] or [first])
        if viewpoints:
            server.initial_camera.near = NEAR
        _add_gaussians(server, gaussians, first.extrinsics[:3, 3], unit)
        for index, view in enumerate(viewpoints):
            _add_viewpoint(server, index, view, first.extrinsics[:3, 3], unit)
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
    # viser would take the next free port instead, and say so where nobody looks
    try:
        with socket.create_server((host, port)):
            pass
    except (OSError, OverflowError) as error:
        reason = str(getattr(error, "strerror", None) or error).split(" (")[0]
        raise InputError(f"cannot serve at {host} port {port}: {reason}; choose another --port, or 0 for any") from None
    with _quiet():
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
    axes = rotation_matrices(gaussians.quats) * np.minimum(unit * gaussians.scales, LARGEST_SCALE)[:, None]
    server.scene.add_gaussian_splats(
        "/Gaussians",
        centers=unit * (gaussians.means - origin),
        covariances=axes @ axes.transpose(0, 2, 1),
        rgbs=to_bytes(gaussians.colours),
        opacities=to_bytes(gaussians.opacities)[:, None],
    )


def _add_viewpoint(server: "viser.ViserServer", index: int, view: Viewpoint, origin: np.ndarray, unit: float) -> None:
    camera, photograph = view
    fov = _field_of_view(camera)
    aspect = camera.width / camera.K[0, 0] * camera.K[1, 1] / camera.height
    if photograph is not None:
        factor = min(1, PHOTOGRAPH_SIDE / max(photograph.shape[:2]))
        photograph = cv2.resize(photograph, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # viser's scale is that of a pyramid of volume 4 / 9, whatever its angles
    scale = FRUSTUM_DEPTH * float(np.cbrt(math.tan(fov / 2) ** 2 * aspect / 3))
    server.scene.add_camera_frustum(
        f"/photographs/{index} {PurePosixPath(camera.name).name}",
        fov,
        aspect,
        scale=scale,
        thickness=LINE,
        image=photograph,
        wxyz=quaternions_from_matrices(camera.extrinsics[None, :3, :3])[0],
        position=unit * (camera.extrinsics[:3, 3] - origin),
        cast_shadow=False,
        receive_shadow=False,
    )


def _field_of_view(camera: Camera) -> float:
    """From top to bottom, in radians, as if the principal point were in the middle."""
    return 2 * math.atan(camera.height / 2 / camera.K[1, 1])
