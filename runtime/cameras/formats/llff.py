"""LLFF's poses_bounds.npy: a row of 17 numbers for each photograph, in the order of their names.

A row is a 3 x 5 matrix and two depths. The matrix holds a camera-to-world pose, whose axes point down, right and
backwards, and a column of height, width and focal length in pixels; the principal point is the middle. The depths are
of the nearest and the farthest of COLMAP's points, so that near and far get some room. No photographs are named.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import intrinsic_matrix
from ...system.files import check_regular
from ..camera import Camera

FILE_NAME = "poses_bounds.npy"
COLUMNS = 17
NEAR_ROOM, FAR_ROOM = 0.75, 1.5
IMAGE_FOLDERS = ("images", "images_4", "images_8")


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read the file; `images`, or those in `images` beside the file, give the names. Raises InputError."""
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
    return Camera(name, int(width), int(height), K, pose, depth_range=(NEAR_ROOM * near, FAR_ROOM * far))


def _rows(path: Path) -> np.ndarray:
    """The array [photographs, 17], float64."""
    try:
        check_regular(path)
        # Mapped, so that a header that promises more than there is costs no memory.
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error}); expected LLFF's {FILE_NAME}") from None
    except Exception as error:  # a damaged header raises many kinds
        raise InputError(f"is not a NumPy array ({error}); expected LLFF's {FILE_NAME}") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f":
        kind = f"{rows.dtype} of shape {rows.shape}" if isinstance(rows, np.ndarray) else "several arrays"
        raise InputError(f"holds {kind}, expected floating-point numbers, [photographs, {COLUMNS}]")
    if len(rows) == 0:
        raise InputError(f"holds no photograph, expected [photographs, {COLUMNS}]")
    return np.array(rows, np.float64)


def _names(count: int, folder: Path, images: Sequence[Path]) -> list[str]:
    """The photographs that the rows belong to: all that were given, or those beside the file, if the number is right.

    Without any, the rows are numbered.
    """
    from ..image_files import images_in_folder

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
