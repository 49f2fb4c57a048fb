"""Depth maps corrected by stereo matching, once all views are there: the network sees two or three at a time.

A pixel has few candidates: its depth, a little less and more, and the depths of the neighbours' surfaces there. It
takes the one that suits the other views best (`DepthRating`), unless that would leave a speckle.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from ..inference.predictor import Prediction
from ..splats.surfaces import project_to_pixel
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from ..views.batch import ViewBatch
from .agreement import SQUARE
from .rating import DepthRating
from .speckles import find_speckles

MIN_VIEWS = 3  # the network saw both of two at once
STEPS = (0.99, 1.01)  # candidates, times the depth; the network's median error is 0.8 %
# By which a candidate must be better than the depth as predicted. With three views, few votes speak against a wrong
# match.
OWN_MARGIN, OWN_MARGIN_OF_THREE = 0.1, 0.2


def correct_depths(prediction: Prediction, views: ViewBatch, voters: list[np.ndarray]) -> Prediction:
    """The prediction with its depths, and its Gaussians along their rays, moved to where the views match.

    voters: for each view, the others that are asked, nearest first, as arrays of indices. Fewer than MIN_VIEWS views
    stay as they are.
    """
    count = len(views.names)
    if count < MIN_VIEWS:
        return prediction
    margin = OWN_MARGIN_OF_THREE if count == 3 else OWN_MARGIN
    rating = DepthRating(prediction.depth, views, voters)

    def correct(view: int) -> np.ndarray:
        own = depth = rating.surfaces.depth[view]
        best = rating.rate(view, own) + margin
        for candidate in _candidates(rating, view):
            rated = rating.rate(view, candidate)
            depth, best = np.where(rated > best, candidate, depth), np.maximum(rated, best)
        return np.where(find_speckles(depth), own, depth)

    return _at_depth(prediction, np.stack(map_in_threads(correct, count)), views.extrinsics)


def _candidates(rating: DepthRating, view: int) -> Iterator[np.ndarray]:
    """Other depth maps for a view than its own, float32 [height, width]."""
    surfaces = rating.surfaces
    own = surfaces.depth[view]
    for step in STEPS:
        yield own * np.float32(step)
    for source in rating.sources[view]:
        seen = np.full(own.shape, np.inf, np.float32)
        _project(surfaces.points[source], surfaces.viewmats[view], surfaces.Ks[view], seen)
        closed = np.where(np.isfinite(seen), seen, cv2.erode(seen, SQUARE))  # points fall beside some pixels
        yield np.where(closed < np.finfo(np.float32).max, closed, own)


def _at_depth(prediction: Prediction, depth: np.ndarray, extrinsics: np.ndarray) -> Prediction:
    """The prediction at other depths [views, height, width]: its Gaussians keep their size in their own view."""
    gaussians = prediction.need_gaussians()
    factors = (depth / prediction.depth).reshape(len(depth), -1, 1)
    centres = extrinsics[:, None, :3, 3].astype(np.float32)
    rays = gaussians.means.reshape(len(depth), -1, 3) - centres
    means = (centres + rays * factors).reshape(-1, 3)
    return replace(
        prediction,
        depth=depth,
        gaussians=replace(gaussians, means=means, scales=gaussians.scales * factors.reshape(-1, 1)),
    )


@compiled()
def _project(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray, depth: np.ndarray) -> None:
    """Lower a view's depth [height, width] to that of the points [height, width, 3] that fall on its pixels."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            z, y, x = project_to_pixel(points[row, column], viewmat, K, height, width)
            if y >= 0 and z < depth[y, x]:
                depth[y, x] = z
