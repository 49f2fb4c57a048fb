"""Pointmaps of photographs: files with the 3D point of each pixel, as networks such as DUSt3R and VGGT predict them.

`DIR/FOLDER/IMAGE.npy` belongs to the image `IMAGE` of the capture `FOLDER`: float [height, width, 3], of the whole
image as it was taken, lens distortion included, at any size. All of a capture's pointmaps have one frame and one scale,
which need not be those of its cameras. NaN marks pixels without a point.
"""

from pathlib import Path

import numpy as np

from ....runtime.cameras.camera import Camera, resize_camera
from ....runtime.cameras.undistortion import undistort
from ....runtime.errors import InputError
from ....runtime.images.resizing import resize_and_crop

SUFFIX = ".npy"
EXPECTED = "float [height, width, 3], one point for each pixel"


def pointmap_path(folder: Path, image: Path) -> Path:
    """The file that belongs to an image `.../FOLDER/IMAGE` or `.../FOLDER/images/IMAGE`."""
    capture = image.parent.parent if image.parent.name == "images" else image.parent
    return folder / capture.name / f"{image.stem}{SUFFIX}"


def check_pointmap(folder: Path, image: Path) -> None:
    """Raise InputError if an image has no pointmap, or a file is none."""
    _read(pointmap_path(folder, image))


def load_pointmap(folder: Path, image: Path, camera: Camera, height: int, width: int) -> np.ndarray:
    """The points of the pixels of an image that was undistorted, resized and cropped to height x width.

    Returns float32 [height * width, 3]. Points are taken from the nearest pixel, since interpolation would make points
    between two surfaces.
    """
    points = _read(pointmap_path(folder, image))
    rows, columns = points.shape[:2]
    scaled = resize_camera(camera, columns, rows)
    # An image whose values are its pixels' positions goes through the same steps as the photograph.
    positions = np.stack([*np.meshgrid(np.arange(columns), np.arange(rows)), np.zeros((rows, columns))], axis=-1)
    undistorted, pinhole = undistort(positions.astype(np.float32), scaled)
    found, _ = resize_and_crop(undistorted, pinhole.K, height, width)  # divided by 255, as images are
    column, row = np.rint(found[:2] * 255).astype(int)
    inside = points[row.clip(0, rows - 1), column.clip(0, columns - 1)]
    return np.ascontiguousarray(inside.reshape(-1, 3), np.float32)


def _read(path: Path) -> np.ndarray:
    """A pointmap without its pixels' values read yet."""
    try:
        points = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise InputError(f"{path}: is not there; --pointmaps needs one for each image, {EXPECTED}") from None
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as .npy ({error}); expected {EXPECTED}") from None
    if points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind != "f":
        raise InputError(f"{path}: is {points.dtype} {list(points.shape)}, expected {EXPECTED}")
    return points
