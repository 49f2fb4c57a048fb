"""Images with their cameras as refinement takes them: at a working size, undistorted, with weights of the pixels."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera, resize_camera
from ..cameras.undistortion import UndistortedImage, undistorted_copy
from ..errors import InputError, error_context
from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..images.io import load_image
from ..system.progress import progress
from ..views.batch import ViewBatch
from .refine import PosedImage


def load_posed_images(pairs: Sequence[tuple[Path, Camera]], max_side: int) -> list[PosedImage]:
    """Read images and shrink them to at most `max_side` pixels on their longer side, keeping their shape.

    Raises InputError if an image cannot be read, or if its size does not match its camera.
    """
    if not pairs:
        raise InputError("no images to refine on; give those that the cameras were made for")
    copies = [_load(path, camera, max_side) for path, camera in progress(pairs, "reading images")]
    return [posed_image(copy, copy.camera.extrinsics) for copy in copies]


def posed_image(copy: UndistortedImage, extrinsics: np.ndarray) -> PosedImage:
    """A copy of an image as refinement takes it; pixels that the lens did not see have no weight."""
    image = copy.image.astype(np.float32) / 255
    return PosedImage(image, invert_rigid(extrinsics), copy.camera.K, copy.valid)


def posed_images(views: ViewBatch) -> list[PosedImage]:
    """The images that the network gets, to fit to; all of their pixels count."""
    height, width = views.images.shape[2:]
    Ks = denormalize_intrinsics(views.intrinsics, width, height)
    valid = np.ones((height, width), bool)
    images = views.images.transpose(0, 2, 3, 1)
    return [
        PosedImage(image, invert_rigid(pose), K, valid)
        for image, pose, K in zip(images, views.extrinsics, Ks, strict=True)
    ]


def _load(path: Path, camera: Camera, max_side: int) -> UndistortedImage:
    image = load_image(path)
    with error_context(str(path)):
        camera = resize_camera(camera, image.shape[1], image.shape[0])
    return undistorted_copy(image, camera, max_side)
