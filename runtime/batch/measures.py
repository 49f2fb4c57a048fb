"""What a record says of a scene's quality, and its picture."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..images.colormaps import colormap_depth, inverse_depth_range, to_uint8
from ..reconstruction.result import Reconstruction
from ..rendering.render import render_view

PICTURE_SIDE = 384  # pixels, of the longer side
JPEG_QUALITY = 85


def measure(result: Reconstruction) -> tuple[float | None, np.ndarray]:
    """The mean PSNR of the input views in dB, and the picture of the scene, RGB uint8 [h, w, 3].

    The picture shows the Gaussians from the first view. Of a model that predicts depth alone it shows that view's
    depth, and there is no PSNR.
    """
    if result.gaussians is None:
        return None, to_uint8(colormap_depth(result.depth[0], inverse_depth_range(result.depth)))
    first, scores = None, []
    for image, rendered in _views(result):
        first = rendered if first is None else first
        scores.append(cv2.PSNR(image, rendered))
    assert first is not None  # a reconstruction has views
    return float(np.mean(scores)), first


def _views(result: Reconstruction) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Each view's image as the network saw it, and what the Gaussians show from there; RGB, uint8 [h, w, 3]."""
    views, gaussians = result.views, result.prediction.need_gaussians()
    height, width = result.depth.shape[1:]
    Ks = denormalize_intrinsics(views.intrinsics, width, height)
    for image, pose, K in zip(views.images, views.extrinsics, Ks, strict=True):
        yield to_uint8(image.transpose(1, 2, 0)), to_uint8(render_view(gaussians, pose, K, width, height).rgb)


def save_picture(path: Path, picture: np.ndarray) -> None:
    """Write a small JPEG. Raises OSError if it cannot be written."""
    height, width = picture.shape[:2]
    scale = min(1.0, PICTURE_SIDE / max(height, width))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    small = cv2.resize(picture[..., ::-1], size, interpolation=cv2.INTER_AREA)
    path.write_bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
