"""Images with their cameras as refinement takes them: at a working size, undistorted, with weights of the pixels."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..cameras.camera import Camera, resize_camera
from ..cameras.undistortion import undistort, undistortion_valid_mask
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
    height, width = image.shape[:2]
    with error_context(str(path)):
        camera = resize_camera(camera, width, height)
    factor = min(1, max_side / max(height, width))
    width, height = max(1, round(width * factor)), max(1, round(height * factor))
    image, camera = (
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA),
        resize_camera(camera, width, height),
    )
    weights = undistortion_valid_mask(camera)[..., None].astype(np.float32)
    image, camera = undistort(image, camera)
    return PosedImage(image.astype(np.float32) / 255, invert_rigid(camera.extrinsics), camera.K, weights)
