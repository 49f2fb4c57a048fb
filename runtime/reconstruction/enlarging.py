"""Predictions of larger images: the network is given them smaller, and its result is enlarged to their size.

A network is accurate near the size of the images that it was trained with. Of larger ones a patch shows it less, so
that plain surfaces get wrong depth. Here depth comes from smaller images, colours from the whole ones: at each pixel of
a whole image the Gaussian of the smaller image's pixel there is repeated, at the interpolated depth, with scales that
shrink as the pixels do, and with a colour that changes by the difference between both images.
"""

from dataclasses import replace

import cv2
import numpy as np

from ..geometry.intrinsics import scale_intrinsics
from ..geometry.sh import SH_0
from ..images.sizes import whole_frame_size
from ..inference.model_files import ModelFiles
from ..inference.predictor import Prediction, Predictor
from ..splats.gaussians import Gaussians
from ..splats.points import unproject
from ..views.batch import ViewBatch

# In areas of the images of its training: the least that is too large for a network, and about what it is given instead.
# Whole frames of high quality are smaller (`quality.PRESETS`).
TOO_LARGE, GIVEN = 2.6, 2


def network_size(model: ModelFiles, height: int, width: int) -> tuple[int, int]:
    """Height and width at which the network predicts images of this size: theirs, unless they are too large for it."""
    own = model.metadata
    trained = own.height * own.width
    if own.fixed_size or height * width < TOO_LARGE * trained:
        return height, width
    return whole_frame_size(height / width, GIVEN * trained, own.size_multiple)


def predict_enlarged(predictor: Predictor, views: ViewBatch, near: float, far: float) -> Prediction:
    """Depth and Gaussians for each pixel of the views, from images of `network_size`."""
    height, width = views.images.shape[2:]
    size = network_size(predictor.model, height, width)
    if size == (height, width):
        return predictor.predict_views(views, near, far)
    smaller = replace(views, images=_resize(views.images, *size), copies=())
    return _enlarge(predictor.predict_views(smaller, near, far), smaller.images, views)


def _enlarge(prediction: Prediction, images: np.ndarray, views: ViewBatch) -> Prediction:
    """A prediction from smaller images [views, 3, h, w] at the size of the views' images."""
    height, width = views.images.shape[2:]
    scale_y, scale_x = height / images.shape[2], width / images.shape[3]
    depth = np.stack([_interpolate(surface, height, width) for surface in prediction.depth])
    cameras = [
        replace(camera, width=width, height=height, K=scale_intrinsics(camera.K, scale_x, scale_y))
        for camera in prediction.cameras
    ]
    larger = replace(prediction, depth=depth, cameras=cameras)
    if prediction.gaussians is None:
        return larger
    gaussians = _repeat(prediction.gaussians, prediction.depth, depth, views)
    detail = views.images - _nearest(images, height, width)  # [views, 3, height, width]
    gaussians.sh[:, 0] += detail.transpose(0, 2, 3, 1).reshape(-1, 3) / np.float32(SH_0)
    return replace(larger, gaussians=gaussians)


def _resize(images: np.ndarray, height: int, width: int) -> np.ndarray:
    """Images [views, 3, h, w] at a smaller size, float32 [views, 3, height, width]."""
    rows = [np.ascontiguousarray(image.transpose(1, 2, 0)) for image in images]
    resized = [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in rows]
    return np.stack(resized).transpose(0, 3, 1, 2)


def _interpolate(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """A depth map [h, w] at a larger size, float32 [height, width]. Inverse depth is bilinear: planes stay planes."""
    return 1 / cv2.resize(1 / depth, (width, height), interpolation=cv2.INTER_LINEAR)


def _repeat(gaussians: Gaussians, small_depth: np.ndarray, depth: np.ndarray, views: ViewBatch) -> Gaussians:
    """The Gaussian of the pixel there at each pixel of larger depth maps, at its depth and of its size.

    gaussians: one for each pixel of `small_depth`, [views, h, w], ordered by view, row, column. depth: [views, height,
    width].
    """
    place = _nearest(np.arange(small_depth.size).reshape(small_depth.shape), *depth.shape[1:]).ravel()
    repeated = gaussians.select(place)
    closeness = depth.ravel() / small_depth.ravel()[place] * np.sqrt(small_depth[0].size / depth[0].size)
    means = unproject(depth, views.extrinsics, views.intrinsics).reshape(-1, 3).astype(np.float32)
    return replace(repeated, means=means, scales=repeated.scales * closeness[:, None].astype(np.float32))


def _nearest(maps: np.ndarray, height: int, width: int) -> np.ndarray:
    """Maps [..., h, w] at a larger size, [..., height, width]: each pixel has the value at its centre."""
    rows, columns = (
        ((np.arange(large) + 0.5) * small / large).astype(int)
        for large, small in zip((height, width), maps.shape[-2:], strict=True)
    )
    return maps[..., rows[:, None], columns]
