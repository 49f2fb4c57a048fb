"""Baselines for a target view: the nearest image, the best fronto-parallel plane (oracle) and oracle-depth splats.

The plane is fronto-parallel to the target camera. Its depth is chosen by comparing with the target itself, so it is an
upper bound for all methods that predict one depth; a method above it has found relief.
Oracle-depth splats are one splat for each context pixel at its true depth and of its colour. They bound what better
depth can give; the remaining error is pixels that no context view sees, and the splats' resolution.
"""

from math import ceil

import cv2
import numpy as np

from ...runtime.geometry.rigid import invert_rigid
from ...runtime.geometry.sh import SH_0
from ...runtime.splats.gaussians import Gaussians
from ...runtime.splats.points import unproject
from .cases import PosedImages

# Number of planes of the first pass, so that neighbouring planes move a pixel by about one; later passes refine.
FEWEST_PLANES, MOST_PLANES = 64, 1024
RANGE_MARGIN = 2  # planes are tried this factor beyond near and far
REFINEMENT = 8  # of the planes' spacing, in each later pass
# Pixel stride of each pass.
STRIDES = (4, 2, 1)
KEPT = (8, 4, 1)  # planes that the next pass refines: similar ones cannot be told apart with few pixels
TINY = 1e-9
# Standard deviation (pixels) and opacity of oracle-depth splats. Smaller splats occlude less of their neighbours and
# score higher at the images' own size, but leave gaps at four times the size, as in a viewer that fills a screen
# (measured with `tools/figures/splat_sizes.py`): 0.4 pixels lose three times as much there as they gain.
SPLAT_PIXELS, SPLAT_OPACITY = 0.45, 0.95


def nearest_view(context: PosedImages, extrinsics: np.ndarray) -> int:
    """Index of the context view whose camera centre is nearest to that of the pose [4, 4]."""
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
    """The image [height, width, 3] of the plane with the lowest mean squared error, and the plane's depth.

    truth: the target's image. near, far: the scene's depth range in scene units, which may be an estimate.
    The search is uniform in inverse depth and goes from coarse to fine.
    """
    low, high = 1 / (RANGE_MARGIN * far), RANGE_MARGIN / near
    pixels = float(max(_distances(context, extrinsics)) * K[0, 0] * (high - low))  # disparity range
    candidates = np.linspace(low, high, min(max(ceil(pixels), FEWEST_PLANES), MOST_PLANES) + 1)
    step = candidates[1] - candidates[0]
    for stride, kept in zip(STRIDES, KEPT, strict=True):
        sampled = (slice(stride // 2, None, stride),) * 2
        if not valid[sampled].any():
            continue
        errors = {}
        for inverse_depth in candidates:
            image = warp_plane(context, extrinsics, K, inverse_depth, stride)
            errors[inverse_depth] = float(np.square(image - truth[sampled])[valid[sampled]].mean())
        best = np.array(sorted(errors, key=lambda inverse_depth: errors[inverse_depth])[:kept])
        step /= REFINEMENT
        around = best[:, None] + step * np.arange(1 - REFINEMENT, REFINEMENT)
        candidates = np.unique(around.clip(low, high))
    return warp_plane(context, extrinsics, K, best[0]), float(1 / best[0])


def warp_plane(
    context: PosedImages, extrinsics: np.ndarray, K: np.ndarray, inverse_depth: float, stride: int = 1
) -> np.ndarray:
    """The context views warped into a camera by the homography of a fronto-parallel plane at 1 / inverse_depth.

    extrinsics: the target camera's pose, [4, 4]. K: in pixels, [3, 3]. The views that see a pixel are blended with
    weights of one over their cameras' distance; where none sees it, the nearest view is copied.
    stride: render one of so many rows and columns, from `stride // 2`. Returns [height, width, 3] float32.
    """
    sampled = (slice(stride // 2, None, stride),) * 2
    height, width = context.valid[0][sampled].shape
    # From pixels (centres at .5) of the rendered rows and columns to those of the full image.
    offset = stride // 2 + (1 - stride) / 2
    spread = np.array([[stride, 0, offset], [0, stride, offset], [0, 0, 1]])
    weights = 1 / np.maximum(_distances(context, extrinsics), TINY)
    mixed, total = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 1), np.float32)
    for view, weight in enumerate(weights / weights.sum()):
        there = invert_rigid(context.extrinsics[view]) @ extrinsics
        # Homography of the plane n^T X = depth: R + t n^T / depth, between normalised image coordinates.
        homography = there[:3, :3] + inverse_depth * there[:3, 3:] * np.array([[0, 0, 1.0]])
        image, seen = _warped(context, view, context.K(view) @ homography @ np.linalg.inv(K) @ spread, (height, width))
        share = (weight * seen)[..., None].astype(np.float32)
        mixed += share * image
        total += share
    copied = context.image(nearest_view(context, extrinsics))[sampled]
    return np.where(total > 0, mixed / np.maximum(total, TINY), copied)


def oracle_depth_splats(depth: np.ndarray, context: PosedImages) -> Gaussians:
    """One isotropic splat for each context pixel, at its z-depth [views, height, width] and of its colour."""
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
    """A view's image warped by a homography from pixels (centres at .5) of the result, and which of these it sees.

    shape: height and width of the result.
    """
    height, width = shape
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are at integers
    maps = np.linalg.inv(half) @ homography @ half
    size, inverse = (width, height), cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(
        context.image(view), maps, size, flags=cv2.INTER_LINEAR | inverse, borderMode=cv2.BORDER_REPLICATE
    )
    seen = cv2.warpPerspective(context.valid[view].astype(np.uint8), maps, size, flags=cv2.INTER_NEAREST | inverse)
    in_front = maps[2, 0] * np.arange(width) + maps[2, 1] * np.arange(height)[:, None] + maps[2, 2] > 0
    return image, (seen > 0) & in_front


def _distances(context: PosedImages, extrinsics: np.ndarray) -> np.ndarray:
    """Distance from the pose [4, 4] to each context camera, in scene units, [views]."""
    return np.linalg.norm(context.extrinsics[:, :3, 3] - extrinsics[:3, 3], axis=1)
