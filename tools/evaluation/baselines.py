"""What other methods make of a target view: the nearest image copied, one plane warped, and true depth in splats.

The plane stands upright before the target camera, and its depth is the one that comes closest to the target itself: no
way of choosing a depth from the images alone can find a better one. A method that beats it has found relief.
Splats at the true depth, one of its colour for each pixel, show what no depth can mend: what no image saw, and how
coarsely splats draw.
"""

from math import ceil

import numpy as np

from ...runtime.geometry.sh import SH_0
from ...runtime.splats.gaussians import Gaussians
from ...runtime.splats.points import unproject
from .cases import PosedImages

# Planes that are tried: at first neighbours move no pixel by much more than one, then around the best ones closer.
FEWEST_PLANES, MOST_PLANES = 64, 1024
BEYOND = 2
CLOSER = 8
# One of so many pixels a side judges all planes, then those around the best ones, then those around the best of these.
STRIDES = (4, 2, 1)
KEPT = (8, 4, 1)  # planes around which the next ones lie: few pixels do not tell similar ones apart
TINY = 1e-9
# Splats by rule: their standard deviation in pixels, and their opacity. Smaller ones hide less of their neighbours and
# score higher at the images' own size, but leave gaps when seen four times as large, as in a viewer that fills a
# screen (`tools/figures/splat_sizes.py`): 0.4 pixels lose three times as much there as they gain.
SPLAT_PIXELS, SPLAT_OPACITY = 0.45, 0.95


def nearest_view(context: PosedImages, extrinsics: np.ndarray) -> int:
    """The context view whose camera stands nearest to the pose [4, 4]."""
    return int(_distances(context, extrinsics).argmin())


def best_fronto_parallel_plane(
    context: PosedImages,
    truth: np.ndarray,  # [height, width, 3]
    valid: np.ndarray,  # [height, width]
    extrinsics: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    near: float,
    far: float,
) -> tuple[np.ndarray, float]:
    """The image [height, width, 3] of the plane that is most like the truth, and its depth.

    near, far: the scene's depth range. It may be a guess, so planes to twice either side of it are tried.
    """
    low, high = 1 / (BEYOND * far), BEYOND / near
    pixels = float(max(_distances(context, extrinsics)) * K[0, 0] * (high - low))  # that the nearest plane moves
    candidates = np.linspace(low, high, min(max(ceil(pixels), FEWEST_PLANES), MOST_PLANES) + 1)
    step = candidates[1] - candidates[0]
    for stride, kept in zip(STRIDES, KEPT, strict=True):
        judged = (slice(stride // 2, None, stride),) * 2
        if not valid[judged].any():
            continue
        errors = {}
        for inverse_depth in candidates:
            image = warp_plane(context, extrinsics, K, inverse_depth, stride)
            errors[inverse_depth] = float(np.square(image - truth[judged])[valid[judged]].mean())
        best = np.array(sorted(errors, key=lambda inverse_depth: errors[inverse_depth])[:kept])
        step /= CLOSER
        around = best[:, None] + step * np.arange(1 - CLOSER, CLOSER)
        candidates = np.unique(around.clip(low, high))
    return warp_plane(context, extrinsics, K, best[0]), float(1 / best[0])


def warp_plane(
    context: PosedImages, extrinsics: np.ndarray, K: np.ndarray, inverse_depth: float, stride: int = 1
) -> np.ndarray:
    """The context views as a camera sees them if all they show lies on a plane at 1 / inverse_depth before it.

    extrinsics: the camera's pose, [4, 4]. K: in pixels, [3, 3]. Views are mixed by their cameras' nearness, among those
    that see a pixel; where none does, the pixel of the nearest view is copied. Returns [height, width, 3] float32.
    stride: of the image's rows and columns, only one of so many, from `stride // 2`.
    """
    judged = (slice(stride // 2, None, stride),) * 2
    height, width = context.valid[0][judged].shape
    # From pixels (centres at .5) of the rows and columns that are asked for, to those of the image.
    offset = stride // 2 + (1 - stride) / 2
    spread = np.array([[stride, 0, offset], [0, stride, offset], [0, 0, 1]])
    weights = 1 / np.maximum(_distances(context, extrinsics), TINY)
    mixed, total = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 1), np.float32)
    for view, weight in enumerate(weights / weights.sum()):
        there = np.linalg.inv(context.extrinsics[view].astype(np.float64)) @ extrinsics
        # A point of the plane in this camera: depth * (rotation + translation * normal / depth) @ ray.
        flat = there[:3, :3] + inverse_depth * there[:3, 3:] * np.array([[0, 0, 1.0]])
        image, seen = _warped(context, view, context.K(view) @ flat @ np.linalg.inv(K) @ spread, (height, width))
        share = (weight * seen)[..., None].astype(np.float32)
        mixed += share * image
        total += share
    copied = context.image(nearest_view(context, extrinsics))[judged]
    return np.where(total > 0, mixed / np.maximum(total, TINY), copied)


def oracle_depth_splats(depth: np.ndarray, context: PosedImages) -> Gaussians:
    """A round splat for every pixel of the context, at its z-depth [views, height, width] and of its colour."""
    means = unproject(depth, context.extrinsics, context.intrinsics).reshape(-1, 3)
    focal = context.intrinsics[:, 0, 0].astype(np.float64) * depth.shape[2]  # pixels
    pixels = (depth / focal[:, None, None]).ravel()
    colours = context.images.transpose(0, 2, 3, 1).reshape(-1, 3)
    return Gaussians(
        means.astype(np.float32),
        np.repeat(SPLAT_PIXELS * pixels[:, None], 3, axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        np.full(len(means), SPLAT_OPACITY, np.float32),
        ((colours - 0.5) / SH_0)[:, None].astype(np.float32),
    )


def _warped(
    context: PosedImages, view: int, homography: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """A view's image under a homography from pixels (centres at .5) of the result, and where it is seen.

    shape: height and width of the result.
    """
    import cv2

    height, width = shape
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres lie at whole numbers
    maps = np.linalg.inv(half) @ homography @ half
    size, inverse = (width, height), cv2.WARP_INVERSE_MAP
    image = np.ascontiguousarray(context.image(view))
    image = cv2.warpPerspective(image, maps, size, flags=cv2.INTER_LINEAR | inverse, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.warpPerspective(context.valid[view].astype(np.uint8), maps, size, flags=cv2.INTER_NEAREST | inverse)
    in_front = maps[2, 0] * np.arange(width) + maps[2, 1] * np.arange(height)[:, None] + maps[2, 2] > 0
    return image, (seen > 0) & in_front


def _distances(context: PosedImages, extrinsics: np.ndarray) -> np.ndarray:
    """From the pose [4, 4] to each context camera, in scene units, [views]."""
    return np.linalg.norm(context.extrinsics[:, :3, 3] - extrinsics[:3, 3], axis=1)
