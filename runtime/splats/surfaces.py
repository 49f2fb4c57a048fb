"""Depth maps of posed views as surfaces: pixels of other views that points fall on, slopes, sampling distances."""

from functools import cached_property

import cv2
import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..system.compilation import compiled
from .points import pixel_rays

# A colour agrees with a view's if it is within COLOR_TOLERANCE of what COLOR_WINDOW x COLOR_WINDOW pixels span there:
# fine texture is sampled differently by each view, and highlights move.
COLOR_TOLERANCE = 0.15
COLOR_WINDOW = 5
MAX_STEP = 0.05  # relative difference in depth of neighbouring pixels of one surface
MAX_SLOPE = np.tan(np.radians(75))  # steeper, splats would be needles


class Surfaces:
    """The depth maps of posed views, with the views that are asked about each view's points.

    points: world positions of the pixels, float32 [views, height, width, 3]. depth: z-depth, float32 [views, height,
    width]. extrinsics, viewmats: camera-to-world and back, [views, 4, 4]. Ks: in pixels, [views, 3, 3]. neighbors: the
    views that are asked about each view, as arrays of indices. images: RGB in [0, 1], [views, 3, height, width], if
    colours are compared.
    """

    def __init__(
        self,
        points: np.ndarray,
        depth: np.ndarray,
        extrinsics: np.ndarray,
        intrinsics: np.ndarray,
        images: np.ndarray | None = None,
        neighbors: list[np.ndarray] | None = None,
    ) -> None:
        """Keep the views in the form that compiled code reads.

        intrinsics: normalised, [views, 3, 3]. neighbors: by default all other views.
        """
        views, height, width = depth.shape
        if neighbors is None:
            neighbors = [np.delete(np.arange(views), view) for view in range(views)]
        self.neighbors, self.images = neighbors, images
        self.points, self.depth = (np.ascontiguousarray(array, np.float32) for array in (points, depth))
        self.extrinsics = extrinsics.astype(np.float64)
        self.viewmats = np.stack([invert_rigid(pose) for pose in self.extrinsics])
        self.intrinsics = intrinsics
        self.Ks = denormalize_intrinsics(intrinsics, width, height)

    @cached_property
    def color_ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours of the pixels, and the least and greatest that agree with each, uint8 [views, height, width, 3]."""
        if self.images is None:
            nothing = np.zeros((*self.depth.shape, 3), np.uint8)
            return nothing, nothing, nothing
        colors = np.ascontiguousarray((np.clip(self.images, 0, 1) * 255).astype(np.uint8).transpose(0, 2, 3, 1))
        window = np.ones((COLOR_WINDOW, COLOR_WINDOW), np.uint8)
        tolerance = round(255 * COLOR_TOLERANCE)
        least = np.stack([np.maximum(cv2.erode(image, window), tolerance) - tolerance for image in colors])
        most = np.stack([np.minimum(cv2.dilate(image, window), 255 - tolerance) + tolerance for image in colors])
        return colors, least, most

    @cached_property
    def slopes(self) -> np.ndarray:
        """How far the surfaces go along each pixel's ray for a step across it, float64 [views, height, width, 2].

        From differences of inverse depth, which is linear in pixels on a plane, to the neighbour that differs less:
        they do not cross depth edges. At most MAX_SLOPE long.
        """
        slopes = np.empty((*self.depth.shape, 2))
        for view, K in enumerate(self.Ks):
            inverse = 1 / self.depth[view].astype(np.float64)
            slopes[view, ..., 0] = -K[0, 0] * _gradient(inverse, 1) / inverse
            slopes[view, ..., 1] = -K[1, 1] * _gradient(inverse, 0) / inverse
            steepness = np.linalg.norm(slopes[view], axis=-1, keepdims=True)
            slopes[view] *= np.minimum(1, MAX_SLOPE / np.maximum(steepness, MAX_SLOPE))
        return slopes

    def rays(self, view: int) -> np.ndarray:
        """The rays through a view's pixels in the camera's frame, with z = 1, [height, width, 3]."""
        return pixel_rays(self.intrinsics[view], *self.depth.shape[1:])

    @cached_property
    def spacings(self) -> np.ndarray:
        """Distances between samples along the slope, in world units, float32 [views, height, width]."""
        spacings = np.empty(self.depth.shape, np.float32)
        for view, depth in enumerate(self.depth):
            spacings[view] = depth / self.Ks[view, 0, 0] * np.hypot(1, np.linalg.norm(self.slopes[view], axis=-1))
        return spacings


def _gradient(inverse: np.ndarray, axis: int) -> np.ndarray:
    """The change of inverse depth per pixel along an axis, to the neighbour that differs less; 0 at depth edges."""
    before, after = (np.take(inverse, np.arange(inverse.shape[axis] - 1) + offset, axis) for offset in (0, 1))
    step = after - before
    step[np.abs(step) > MAX_STEP * np.minimum(before, after)] = np.inf
    border = np.full_like(np.take(inverse, [0], axis), np.inf)
    forward, backward = np.concatenate([step, border], axis), np.concatenate([border, step], axis)
    smaller = np.where(np.abs(forward) <= np.abs(backward), forward, backward)
    return np.where(np.isfinite(smaller), smaller, 0)


@compiled()
def project_to_pixel(
    point: np.ndarray, viewmat: np.ndarray, K: np.ndarray, height: int, width: int
) -> tuple[float, int, int]:
    """The z-depth of a point, and the row and column of its pixel; the row is -1 outside the image."""
    x, y, z = point[0], point[1], point[2]
    depth = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
    if depth <= 0:
        return depth, -1, 0
    across = viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]
    down = viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]
    column, row = K[0, 0] * across / depth + K[0, 2], K[1, 1] * down / depth + K[1, 2]
    if not (0 <= column < width and 0 <= row < height):
        return depth, -1, 0
    return depth, int(row), int(column)


@compiled()
def color_agrees(color: np.ndarray, least: np.ndarray, most: np.ndarray) -> bool:
    """Whether a colour [3] is within a range."""
    red = least[0] <= color[0] <= most[0]
    return red and least[1] <= color[1] <= most[1] and least[2] <= color[2] <= most[2]
