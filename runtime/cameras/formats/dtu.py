"""MVSNet camera files (DTU, BlendedMVS, Tanks and Temples): one `<name>_cam.txt` for each image.

    extrinsic              then 4 rows: world-to-camera, OpenCV axes
    intrinsic              then 3 rows: K in pixels
    425.0 2.5              minimum depth and depth interval; often also the number of planes and the maximum depth

`00000003_cam.txt` is the camera of `00000003.jpg`, or in DTU of `rect_004_....png`. The files do not hold the image
size, so the images must be given or lie beside the file. K is multiplied by 4 where its principal point shows that it
was made for a quarter of the image size, as in MVSNet's training set. Pixel centres are taken to be at half-integers,
since most of these files are converted from COLMAP.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.intrinsics import scale_intrinsics
from ...geometry.rigid import invert_rigid
from ...images.finding import image_stem
from ...images.header import image_size
from ..camera import Camera
from ..image_files import GIVE_IMAGES, images_in_folder
from ..parsing import numbers, read_text
from ..source import CameraSource

DESCRIPTION = "MVSNet's *_cam.txt"
ENDINGS = ("_cam.txt", "cam.txt")
IMAGE_FOLDERS = (".", "..", "../images", "../blended_images", "../image")
DTU_IMAGE = re.compile(r"rect_(\d+)_")  # numbered from 1, the camera files from 0
QUARTER_SCALE = 4  # image size over the size that K in MVSNet's training set is for
DEFAULT_PLANES = 192
CENTRE_RANGE = (0.4, 0.6)  # of plausible principal points, in image widths and heights


def detect(source: CameraSource) -> bool:
    """Whether a file starts with `extrinsic`, or a folder holds *_cam.txt files."""
    return bool(files_in(source.path)) if source.is_folder else source.start.startswith(b"extrinsic")


def input_files(path: Path) -> list[Path]:
    """The *_cam.txt files of a folder."""
    return files_in(path) if path.is_dir() else []


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read one file, or all `*_cam.txt` of a folder. images: give the image sizes. Raises InputError."""
    files = files_in(path) if path.is_dir() else [path]
    if not files:
        raise InputError("holds no *_cam.txt, expected one for each image")
    candidates = [*images, *_images_near(files[0].parent)]
    cameras = []
    for file in files:
        with error_context(file.name):
            cameras.append(_camera(file, candidates))
    return cameras


def files_in(folder: Path) -> list[Path]:
    """The *_cam.txt files of a folder, sorted by name."""
    return sorted(folder.glob(f"*{ENDINGS[0]}"))


def _camera(file: Path, candidates: Sequence[Path]) -> Camera:
    pose, K, depth_range = _parse(read_text(file))
    name = file.name
    for ending in ENDINGS:
        name = name.removesuffix(ending)
    image = _image(name, candidates)
    if image is None:
        raise InputError(f"gives no size in pixels, and there is no image {name}.*; {GIVE_IMAGES}")
    width, height = image_size(image)
    if _is_quarter(K, width, height):
        K = scale_intrinsics(K, QUARTER_SCALE, QUARTER_SCALE)
    return Camera(image.name, width, height, K, invert_rigid(pose), depth_range=depth_range)


def _parse(text: str) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None]:
    """World-to-camera [4, 4], K [3, 3] and the depth range."""
    words = text.split()
    if words[:1] != ["extrinsic"] or words[17:18] != ["intrinsic"]:
        raise InputError("expected 'extrinsic' and 16 numbers, then 'intrinsic' and 9 numbers")
    with error_context("extrinsic"):
        pose = np.array(numbers(words[1:17])).reshape(4, 4)
    with error_context("intrinsic"):
        values = numbers(words[18:27])
        if len(values) != 9:
            raise InputError(f"has {len(values)} numbers, expected 9: is the file truncated?")
        K = np.array(values).reshape(3, 3)
    with error_context("depth"):
        return pose, K, _depth_range(numbers(words[27:31]))


def _depth_range(values: Sequence[float]) -> tuple[float, float] | None:
    """values: minimum depth, interval, and optionally the number of planes and the maximum depth."""
    if not values:
        return None
    if len(values) == 1:
        raise InputError("is one number, expected at least the minimum depth and the interval")
    minimum, interval = values[:2]
    planes = values[2] if len(values) > 2 else DEFAULT_PLANES
    return minimum, values[3] if len(values) > 3 else minimum + interval * (planes - 1)


def _image(name: str, candidates: Sequence[Path]) -> Path | None:
    for candidate in candidates:
        if image_stem(candidate) == name:
            return candidate
    if name.isdecimal():
        for candidate in candidates:
            numbered = DTU_IMAGE.match(candidate.name)
            if numbered and int(numbered[1]) == int(name) + 1:
                return candidate
    return None


def _images_near(folder: Path) -> list[Path]:
    return [image for name in IMAGE_FOLDERS for image in images_in_folder(folder / name)]


def _is_quarter(K: np.ndarray, width: int, height: int) -> bool:
    centre = K[:2, 2] * QUARTER_SCALE / (width, height)
    return bool(((centre > CENTRE_RANGE[0]) & (centre < CENTRE_RANGE[1])).all())
