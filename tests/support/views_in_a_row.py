"""Cameras in a row, all looking along z: their views, and Gaussians at the depth of each pixel."""

from collections.abc import Sequence

import numpy as np
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.points import unproject
from idesplat.runtime.views.batch import ViewBatch


def extrinsics_in_a_row(*positions: float) -> np.ndarray:
    """Poses on the x axis, camera-to-world [cameras, 4, 4]."""
    extrinsics = np.tile(np.eye(4), (len(positions), 1, 1))
    extrinsics[:, 0, 3] = positions
    return extrinsics


def views_in_a_row(images: np.ndarray, positions: Sequence[float], K: np.ndarray) -> ViewBatch:
    """Views of images [views, 3, height, width] from positions on the x axis. K: of all, in pixels."""
    count, _, height, width = images.shape
    extrinsics = extrinsics_in_a_row(*positions)
    intrinsics = np.tile((K / [[width], [height], [1]]).astype(np.float32), (count, 1, 1))
    names = [f"{view}.png" for view in range(count)]
    cameras = [Camera(name, width, height, K, pose) for name, pose in zip(names, extrinsics, strict=True)]
    return ViewBatch(names, images, extrinsics, intrinsics, cameras)


def prediction_of(depth: np.ndarray, views: ViewBatch, scale: float = 1.0) -> Prediction:
    """Grey, opaque, round Gaussians at the depth [views, height, width] of each pixel. scale: in world units."""
    means = unproject(depth, views.extrinsics, views.intrinsics).reshape(-1, 3).astype(np.float32)
    count = len(means)
    gaussians = Gaussians(
        means,
        np.full((count, 3), scale, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 0.9, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    return Prediction(depth.astype(np.float32), gaussians)
