"""LLFF's poses_bounds.npy: 17 numbers for each image, in the order of the image names, which it does not store.

A row is a 3 x 5 matrix and a depth range. The matrix is a camera-to-world pose whose axes point down, right and
backwards, and a column of height, width and focal length in pixels; the principal point is the image centre. The depth
range is that of COLMAP's points, so it is widened by a margin.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import intrinsic_matrix
from ...system.files import check_regular
from ..camera import Camera
from ..image_files import images_in_folder
from ..source import CameraSource

DESCRIPTION = "LLFF's poses_bounds.npy"
FILE_NAME = "poses_bounds.npy"
COLUMNS = 17
NEAR_MARGIN, FAR_MARGIN = 0.75, 1.5
IMAGE_FOLDERS = ("images", "images_4", "images_8")


def detect(source: CameraSource) -> bool:
    """Whether a file is a NumPy array, or a folder holds a poses_bounds.npy."""
    if source.is_folder:
        return (source.path / FILE_NAME).is_file()
    return source.start.startswith(b"\x93NUMPY")


def input_files(path: Path) -> list[Path]:
    """The poses_bounds.npy of a folder."""
    return [path / FILE_NAME] if path.is_dir() else []


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file. images: give the names; by default those in `images` beside the file. Raises InputError."""
    path = path / FILE_NAME if path.is_dir() else path
    rows = _rows(path)
    cameras = []
    for index, (name, row) in enumerate(zip(_names(len(rows), path.parent, images), rows, strict=True)):
        with error_context(f"row {index} ({name})"):
            cameras.append(_camera(name, row))
    return cameras


def _camera(name: str, row: np.ndarray) -> Camera:
    if not np.isfinite(row).all():
        raise InputError("holds NaN or infinity, expected finite numbers")
    down, right, backwards, position, (height, width, focal) = row[:15].reshape(3, 5).T
    if height != round(height) or width != round(width):
        raise InputError(f"the image's size is {width:g} x {height:g}, expected whole pixels")
    pose = np.eye(4)
    pose[:3] = np.stack([right, down, -backwards, position], axis=1)
    K = intrinsic_matrix(focal, focal, width / 2, height / 2)
    near, far = float(row[15]), float(row[16])
    return Camera(name, int(width), int(height), K, pose, depth_range=(NEAR_MARGIN * near, FAR_MARGIN * far))


def _rows(path: Path) -> np.ndarray:
    """The array [images, 17], float64."""
    try:
        check_regular(path)
        # Memory-mapped, so that a damaged header with a large shape allocates nothing.
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error}); expected LLFF's {FILE_NAME}") from None
    except Exception as error:  # NumPy raises many types for damaged headers
        raise InputError(f"is not a NumPy array ({error}); expected LLFF's {FILE_NAME}") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f":
        kind = f"{rows.dtype} of shape {rows.shape}" if isinstance(rows, np.ndarray) else "several arrays"
        raise InputError(f"holds {kind}, expected floating-point numbers, [images, {COLUMNS}]")
    if len(rows) == 0:
        raise InputError(f"holds no cameras, expected [images, {COLUMNS}]")
    return np.array(rows, np.float64)


def _names(count: int, folder: Path, images: Sequence[Path]) -> list[str]:
    """The image names of the rows: of the images given, or of those beside the file, if there are `count` of them.

    Without images, the rows are numbered. Raises InputError if another number of images is given.
    """
    found = [
        sorted(images, key=lambda image: image.name),
        *(images_in_folder(folder / name) for name in IMAGE_FOLDERS),
    ]
    for candidates in found:
        if len(candidates) == count:
            return [candidate.name for candidate in candidates]
    if images:
        raise InputError(
            f"holds {count} cameras without names, and {len(images)} images were given; give all {count}, "
            f"or keep them in {IMAGE_FOLDERS[0]} beside the file"
        )
    return [f"{index:03}" for index in range(count)]
