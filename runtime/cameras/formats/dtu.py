"""Camera files of MVSNet and its kin (DTU, BlendedMVS, Tanks and Temples): one `<name>_cam.txt` for each image.

    extrinsic              then 4 rows of a world-to-camera pose, OpenCV axes
    intrinsic              then 3 rows of K in pixels
    425.0 2.5              the least depth, the interval between planes; often their number and the largest depth

A file `00000003_cam.txt` belongs to the image `00000003.jpg`, or in DTU to `rect_004_....png`. The size of the
image is not in the file, so it must be given or stand beside. Where the principal point shows that K is meant for a
quarter of the image's size, as in MVSNet's training set, K is multiplied by four. The principal point is taken as
COLMAP's, with the centre of the first pixel at (.5, .5), since most of these files are made from COLMAP's.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError, error_context
from ...geometry.rigid import invert_rigid
from ..camera import Camera
from ..parsing import numbers, read_text

ENDINGS = ("_cam.txt", "cam.txt")
IMAGE_FOLDERS = (".", "..", "../images", "../blended_images", "../image")
DTU_PICTURE = re.compile(r"rect_(\d+)_")  # counted from 1, while the camera files are from 0
QUARTER = 4  # size of the image over that which MVSNet's training K is meant for
USUAL_PLANES = 192  # where a file does not say how many there are
MIDDLE = (0.4, 0.6)  # where principal points are, in widths and heights


def read(path: Path, images: Sequence[Path] = ()) -> list[Camera]:
    """Read one file, or all `*_cam.txt` of a folder; `images` give the size. Raises InputError."""
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
    """The camera files of a folder, in the order of their names."""
    return sorted(folder.glob(f"*{ENDINGS[0]}"))


def _camera(file: Path, candidates: Sequence[Path]) -> Camera:
    from ...images.header import image_size
    from ..image_files import GIVE_IMAGES

    pose, K, depth_range = _parse(read_text(file))
    name = file.name
    for ending in ENDINGS:
        name = name.removesuffix(ending)
    image = _image(name, candidates)
    if image is None:
        raise InputError(f"gives no size in pixels, and there is no image {name}.*; {GIVE_IMAGES}")
    width, height = image_size(image)
    if _is_quarter(K, width, height):
        K = np.diag([QUARTER, QUARTER, 1]) @ K
    return Camera(image.name, width, height, K, invert_rigid(pose), depth_range=depth_range)


def _parse(text: str) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None]:
    """World-to-camera pose [4, 4], K [3, 3], nearest and farthest depth."""
    words = text.split()
    if words[:1] != ["extrinsic"] or words[17:18] != ["intrinsic"]:
        raise InputError("expected 'extrinsic' and 16 numbers, then 'intrinsic' and 9 numbers")
    with error_context("extrinsic"):
        pose = np.array(numbers(words[1:17])).reshape(4, 4)
    with error_context("intrinsic"):
        values = numbers(words[18:27])
        if len(values) != 9:
            raise InputError(f"has {len(values)} numbers, expected 9: is the file cut off?")
        K = np.array(values).reshape(3, 3)
    with error_context("depth"):
        return pose, K, _depth_range(numbers(words[27:31]))


def _depth_range(values: Sequence[float]) -> tuple[float, float] | None:
    """From the least depth, the interval, and where given the number of planes and the largest depth."""
    if not values:
        return None
    if len(values) == 1:
        raise InputError("is one number, expected the least depth and the interval at least")
    least, interval = values[:2]
    planes = values[2] if len(values) > 2 else USUAL_PLANES
    return least, values[3] if len(values) > 3 else least + interval * (planes - 1)


def _image(name: str, candidates: Sequence[Path]) -> Path | None:
    from ...images.io import image_stem

    for candidate in candidates:
        if image_stem(candidate) == name:
            return candidate
    if name.isdecimal():
        for candidate in candidates:
            numbered = DTU_PICTURE.match(candidate.name)
            if numbered and int(numbered[1]) == int(name) + 1:
                return candidate
    return None


def _images_near(folder: Path) -> list[Path]:
    from ..image_files import images_in_folder

    return [image for place in IMAGE_FOLDERS for image in images_in_folder(folder / place)]


def _is_quarter(K: np.ndarray, width: int, height: int) -> bool:
    shares = K[:2, 2] * QUARTER / (width, height)
    return bool(((shares > MIDDLE[0]) & (shares < MIDDLE[1])).all())
