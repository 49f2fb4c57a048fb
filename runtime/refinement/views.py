"""Images with their cameras as refinement takes them: at a working size, undistorted, with weights of the pixels."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera, resize_camera
from ..cameras.undistortion import shrink, undistort, undistortion_valid_mask
from ..errors import InputError, error_context
from ..geometry.rigid import invert_rigid
from ..images.io import load_image
from ..system.progress import progress
from .refine import PosedImage


def load_posed_images(pairs: Sequence[tuple[Path, Camera]], max_side: int) -> list[PosedImage]:
    """Read images and shrink them to at most `max_side` pixels on their longer side, keeping their shape.

    Pixels that undistortion takes from outside the image have weight 0.
    Raises InputError if an image cannot be read, or if its size does not match its camera.
    """
    if not pairs:
        raise InputError("no images to refine on; give those that the cameras were made for")
    return [_load(path, camera, max_side) for path, camera in progress(pairs, "reading images")]


def _load(path: Path, camera: Camera, max_side: int) -> PosedImage:
    image = load_image(path)
    with error_context(str(path)):
        camera = resize_camera(camera, image.shape[1], image.shape[0])
    image, camera = shrink(image, camera, max_side)
    weights = undistortion_valid_mask(camera)[..., None].astype(np.float32)
    image, camera = undistort(image, camera)
    return PosedImage(image.astype(np.float32) / 255, invert_rigid(camera.extrinsics), camera.K, weights)
