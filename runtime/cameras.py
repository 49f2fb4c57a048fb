"""Cameras: one convention inside, and every convention outside converted at the door, a file for each format.

Inside, a pose is camera-to-world with OpenCV axes (x right, y down, z forward) and K is in pixels with the centre of
the top left pixel at (.5, .5). To read another format, write one module with a function `read` that returns `Camera`s,
and name it in `CameraFormat` and `recognise`; `Camera` itself checks what every format can get wrong.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path, PurePosixPath

import numpy as np

from .camera_format import CameraFormat
from .errors import InputError
from .files import open_regular

RIGID_TOLERANCE = 1e-3  # how far a rotation's singular values may be from 1
RIGID_ROUNDING = 1e-12  # below this a rotation is left as it is, so that what we write is read back unchanged
FARTHEST = 1e9  # a coordinate beyond this is a mistake, and float32 could not place a scene around it
SHORTEST_FOCAL, LONGEST_FOCAL = 0.05, 100.0  # in image widths (heights): 169 and 0.6 degrees of view
LARGEST_SIDE = 1_000_000  # pixels
DISTORTION_LENGTHS = (4, 5, 8, 12, 14)  # that OpenCV's model may have
FISHEYE_LENGTH = 4
START = 4096  # bytes of a file that tell its format
RE10K_COLUMNS = 19
COLMAP_PARTS = ("cameras", "images", "frames", "rigs", "points3D")


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated picture.

    name: the image's path as the camera file writes it, such as `images/0001.jpg`.
    width, height: the picture's size in pixels, upright.
    K: float64, pixels, pixel centres at .5, no skew, [3, 3].
    extrinsics: float64, camera-to-world, OpenCV axes (x right, y down, z forward), world units, [4, 4].
    distortion: OpenCV's coefficients, k1 k2 p1 p2 and on as it orders them (4, 5, 8, 12 or 14), or None for a pinhole.
    fisheye: the lens is one of cv2.fisheye's, and distortion its k1 k2 k3 k4.
    depth_range: near and far, between which all lies that it sees, in world units; None where that is not known.

    Raises InputError if a value is not finite or not plausible, or the pose is not rigid.
    A rotation that is off by rounding only (1e-3) is made orthonormal.
    """

    name: str
    width: int
    height: int
    K: np.ndarray
    extrinsics: np.ndarray
    distortion: tuple[float, ...] | None = None
    fisheye: bool = False
    depth_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (0 < self.width <= LARGEST_SIDE and 0 < self.height <= LARGEST_SIDE):
            size = f"{self.width:.6g} x {self.height:.6g}"
            raise InputError(f"the image's size is {size}, expected 1 to {LARGEST_SIDE} pixels")
        check_intrinsics(self.K, self.width, self.height)
        _check_distortion(self.distortion, self.fisheye)
        if self.depth_range is not None:
            _check_depth_range(self.depth_range)
        object.__setattr__(self, "extrinsics", rigid(self.extrinsics))


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` (a file, a frame, a field) in front of the message of an InputError raised inside the block.

    Once only: what reads a whole file begins with its path, which may end in `where`, or lead through it.
    """
    try:
        yield
    except InputError as error:
        path = Path(str(error).partition(": ")[0])
        known = where in (path.name, str(path), *map(str, path.parents))
        raise InputError(str(error) if known else f"{where}: {error}") from None


def read_cameras(path: Path, pictures: Sequence[Path] = (), form: CameraFormat | None = None) -> list[Camera]:
    """Read a file, or a folder, of cameras.

    pictures: the photographs that the cameras belong to. Some formats do not name them, or do not give their size, and
    then need them here or beside the file; the module of each format says which.
    form: the format, where the content is not to tell it.
    Raises InputError naming the file, the entry and the field.
    """
    path = Path(path)
    with located(str(path)):
        reader = import_module(f".cameras_{form or recognise(path)}", __package__)
        cameras: list[Camera] = reader.read(path, pictures)
        _check_names(cameras)
    return cameras


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write this project's own file, which `read_cameras` reads back unchanged; or a transforms.json, if named so.

    Raises InputError if the folder cannot be written, or the format cannot say what a camera is.
    """
    from . import cameras_own, cameras_transforms

    path = Path(path)
    writer = cameras_transforms if path.name == cameras_transforms.FILE_NAME else cameras_own
    writer.write(path, cameras)


def recognise(path: Path) -> CameraFormat:
    """The format of a file or folder of cameras, by what it holds; raises InputError if it is none of them."""
    if path.is_dir():
        return _recognise_folder(path)
    if path.name in {name + suffix for name in COLMAP_PARTS for suffix in (".bin", ".txt")}:
        return CameraFormat.COLMAP
    try:
        with open_regular(path) as file:
            start = file.read(START).removeprefix(b"\xef\xbb\xbf").lstrip()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror}); expected a file of cameras") from None
    if path.suffix.lower() == ".json" or start.startswith((b"{", b"[")):
        return _recognise_json(path)
    if start.startswith(b"\x93NUMPY"):
        return CameraFormat.LLFF
    if start.startswith((b"%YAML", b"<?xml", b"<opencv_storage")):
        return CameraFormat.OPENCV
    if start.startswith(b"extrinsic"):
        return CameraFormat.DTU
    if any(len(line.split()) == RE10K_COLUMNS for line in start.splitlines()[:2]):
        return CameraFormat.RE10K
    raise InputError(
        "is none of the camera files that are known by their content: transforms.json, a COLMAP model, a RealEstate10K "
        "trajectory, poses_bounds.npy, a cam.txt, OpenCV's stereo calibration, or this project's JSON; "
        "if it is one of them, give --camera-format"
    )


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the same picture at another size in pixels.

    Raises InputError if the aspect differs by more than rounding each side to a whole pixel explains.
    """
    if (width, height) == (camera.width, camera.height):
        return camera
    smallest = max((width - 1) / camera.width, (height - 1) / camera.height)
    largest = min((width + 1) / camera.width, (height + 1) / camera.height)
    if smallest > largest:
        rotated = abs(width / height - camera.height / camera.width) < abs(
            width / height - camera.width / camera.height
        )
        advice = (
            "the cameras were made for the picture turned by 90 degrees: save the pictures as they were then, "
            "without an EXIF rotation"
            if rotated
            else "give the pictures that the cameras were made for, or the same ones scaled"
        )
        raise InputError(
            f"the image has {width} x {height} pixels, its camera {camera.width} x {camera.height}; {advice}"
        )
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=scale @ camera.K)


def relative_cameras(cameras: Sequence[Camera], offset: np.ndarray) -> list[Camera]:
    """Cameras in a world whose origin is at `offset` [3] of theirs, as that of a scene with an offset is."""
    if not offset.any():
        return list(cameras)
    moved = []
    for camera in cameras:
        extrinsics = camera.extrinsics.copy()
        extrinsics[:3, 3] -= offset
        moved.append(replace(camera, extrinsics=extrinsics))
    return moved


def rigid(pose: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] as float64 with an orthonormal rotation.

    Raises InputError if it is not finite, or scaled, sheared or mirrored by more than rounding (1e-3).
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape != (4, 4):
        raise InputError(f"the pose has shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise InputError("the pose holds NaN or infinity, expected finite numbers")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise InputError(f"the pose's last row is {pose[3].tolist()}, expected [0, 0, 0, 1]")
    if np.abs(pose[:3, 3]).max() > FARTHEST:
        raise InputError(f"the camera stands at {pose[:3, 3].tolist()}, expected coordinates below {FARTHEST:g}")
    u, singular, vt = np.linalg.svd(pose[:3, :3])
    error = np.abs(singular - 1).max()
    if error > RIGID_TOLERANCE:
        scales = ", ".join(f"{value:g}" for value in singular)
        kind = "cannot be inverted" if singular[2] < RIGID_TOLERANCE else "is scaled or sheared"
        raise InputError(f"the pose's rotation {kind}: singular values {scales}, expected 1, 1, 1")
    if np.linalg.det(u @ vt) < 0:
        raise InputError("the pose's rotation is mirrored: determinant -1, expected 1; check the axes' convention")
    if error > RIGID_ROUNDING:
        pose = pose.copy()
        pose[:3, :3] = u @ vt
    return pose


def invert_rigid(transform: np.ndarray) -> np.ndarray:
    """The inverse of a pose [4, 4], so that world-to-camera becomes camera-to-world; raises InputError as `rigid`."""
    transform = rigid(transform)
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def check_intrinsics(K: np.ndarray, width: float, height: float) -> None:
    """Check K [3, 3] of an image of this size (1 by 1 for a normalised K); raises InputError."""
    if K.shape != (3, 3):
        raise InputError(f"K has shape {K.shape}, expected (3, 3)")
    if not np.isfinite(K).all():
        raise InputError("K holds NaN or infinity, expected finite numbers")
    if K[0, 1] != 0 or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise InputError(f"K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: no skew")
    image = f"an image of {width} x {height}"
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if min(fx, fy) <= 0:
        raise InputError(f"the focal lengths are {fx:g} and {fy:g}, expected positive ones")
    if min(fx / width, fy / height) < SHORTEST_FOCAL or max(fx / width, fy / height) > LONGEST_FOCAL:
        raise InputError(f"the focal lengths {fx:g} and {fy:g} are not plausible for {image}; check their unit")
    if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise InputError(f"the principal point ({cx:g}, {cy:g}) lies far outside {image}; check its unit")


def _check_distortion(distortion: tuple[float, ...] | None, fisheye: bool) -> None:
    if fisheye and (distortion is None or len(distortion) != FISHEYE_LENGTH):
        raise InputError(f"distortion is {distortion}, expected k1, k2, k3, k4 for a fisheye lens")
    if distortion is None:
        return
    if len(distortion) not in DISTORTION_LENGTHS:
        lengths = ", ".join(map(str, DISTORTION_LENGTHS))
        raise InputError(
            f"distortion is {distortion}, expected k1, k2, p1, p2 and on as OpenCV has it: {lengths} numbers"
        )
    if not np.isfinite(distortion).all():
        raise InputError(f"distortion is {distortion}, expected finite numbers")


def _check_depth_range(depth_range: tuple[float, float]) -> None:
    if len(depth_range) != 2 or not np.isfinite(depth_range).all() or not 0 < depth_range[0] < depth_range[1]:
        raise InputError(f"the range of depth is {depth_range}, expected 0 < nearest < farthest")


def _check_names(cameras: Sequence[Camera]) -> None:
    seen: set[PurePosixPath] = set()
    for index, camera in enumerate(cameras):
        if PurePosixPath(camera.name) in seen:
            raise InputError(
                f"camera {index} names the image {camera.name} a second time, expected one camera for each"
            )
        seen.add(PurePosixPath(camera.name))


# ---- which format


def _recognise_folder(folder: Path) -> CameraFormat:
    from . import cameras_colmap, cameras_dtu, cameras_llff, cameras_transforms

    if (folder / cameras_transforms.FILE_NAME).is_file():
        return CameraFormat.TRANSFORMS
    if cameras_colmap.models_in(folder):
        return CameraFormat.COLMAP
    if (folder / cameras_llff.FILE_NAME).is_file():
        return CameraFormat.LLFF
    if cameras_dtu.files_in(folder):
        return CameraFormat.DTU
    raise InputError(
        "is a folder without transforms.json, COLMAP model, poses_bounds.npy or *_cam.txt; give the file of cameras"
    )


def _recognise_json(path: Path) -> CameraFormat:
    from . import cameras_own
    from .camera_fields import read_json

    document = read_json(path)
    if document.get("format") == cameras_own.FORMAT:
        return CameraFormat.OWN
    if "frames" in document:
        return CameraFormat.TRANSFORMS
    raise InputError(f'no cameras here: expected a transforms.json with "frames", or "format": "{cameras_own.FORMAT}"')
