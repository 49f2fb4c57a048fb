"""The choice among several predictions of a view: at each pixel, the depth that most other views agree with.

Groups of views overlap, so that the network predicts most views several times, each time beside other partners. Which
partners suit a pixel best is not known before: the depth of the views that are asked tells it, as a majority.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from ..geometry.consistency import DEPTH_TOLERANCE
from ..inference.predictor import Prediction
from ..splats.gaussians import Gaussians
from ..splats.points import unproject
from ..splats.surfaces import Surfaces, color_agrees, project_to_pixel
from ..system.compilation import compiled
from ..views.batch import ViewBatch

# Votes that every depth has beside those of the views, half of one for it: few votes decide less than many.
PRIOR_VOTES, PRIOR_SUPPORT = 2.0, 0.5
OWN_MARGIN = 0.1  # by which another group's depth must be better than that of the view's own group
WINDOW = 5  # pixels a side that choose together: neighbours are mostly of one surface
SQUARE = np.ones((3, 3), np.uint8)  # points project between pixels, so their neighbours count as well


class Agreement:
    """The surfaces of all views as their own groups predicted them, which vote on the depth of each.

    depth: z-depth, float32 [views, height, width]. neighbors: the views that are asked about each view, as arrays of
    indices.
    """

    def __init__(self, depth: np.ndarray, views: ViewBatch, neighbors: list[np.ndarray]) -> None:
        self.views = views
        points = np.stack([self._points(view, surface) for view, surface in enumerate(depth)])
        self.surfaces = Surfaces(points, depth, views.extrinsics, views.intrinsics, views.images, neighbors)
        self.colors = self.surfaces.color_ranges  # found here, before several threads ask for it
        self.nearest = np.stack([cv2.erode(surface, SQUARE) for surface in self.surfaces.depth])
        self.farthest = np.stack([cv2.dilate(surface, SQUARE) for surface in self.surfaces.depth])

    def best(self, view: int, predictions: Sequence[Prediction]) -> Prediction:
        """The pixels of several predictions of a view that most of its neighbours agree with, as one prediction.

        predictions: that of the view's own group first, which is kept where no other is better by OWN_MARGIN.
        """
        if len(predictions) == 1:
            return predictions[0]
        scores = [self.score(view, prediction.depth[0]) for prediction in predictions]
        means = np.stack([cv2.blur(score, (WINDOW, WINDOW)) for score in scores])
        means[0] += OWN_MARGIN
        return _merge(predictions, means.argmax(axis=0))

    def score(self, view: int, depth: np.ndarray) -> np.ndarray:
        """The share of the votes for each pixel's depth, float32 [height, width]."""
        s = self.surfaces
        colors, least, most = self.colors
        score = np.empty(depth.shape, np.float32)
        of_view = self._points(view, depth), colors[view], s.neighbors[view]
        _vote(*of_view, self.nearest, self.farthest, s.viewmats, s.Ks, least, most, score)
        return score

    def _points(self, view: int, depth: np.ndarray) -> np.ndarray:
        """The points of a view's depth map [height, width], float32 [height, width, 3]: one view's, to save memory."""
        one = slice(view, view + 1)
        return unproject(depth[None], self.views.extrinsics[one], self.views.intrinsics[one])[0].astype(np.float32)


def _merge(predictions: Sequence[Prediction], chosen: np.ndarray) -> Prediction:
    """One prediction of a view from several, chosen [height, width] at each pixel by index."""
    pixels = np.arange(chosen.size)
    depth = np.stack([prediction.depth.ravel() for prediction in predictions])[chosen.ravel(), pixels]
    sets = [prediction.gaussians for prediction in predictions if prediction.gaussians is not None]
    gaussians = Gaussians.concatenate(sets).select(chosen.ravel() * chosen.size + pixels) if sets else None
    return Prediction(depth.reshape(predictions[0].depth.shape), gaussians, {}, predictions[0].cameras)


@compiled()
def _vote(
    points: np.ndarray,  # [height, width, 3]
    colors: np.ndarray,  # [height, width, 3]
    neighbors: np.ndarray,
    nearest: np.ndarray,  # [views, height, width]
    farthest: np.ndarray,
    viewmats: np.ndarray,
    Ks: np.ndarray,
    least: np.ndarray,  # [views, height, width, 3]
    most: np.ndarray,
    score: np.ndarray,  # [height, width]
) -> None:
    """Of the neighbours that do not see a point occluded, the share that agree with it in depth and colour."""
    height, width = score.shape
    for row in range(height):
        for column in range(width):
            votes, support = PRIOR_VOTES, PRIOR_SUPPORT
            for view in neighbors:
                z, y, x = project_to_pixel(points[row, column], viewmats[view], Ks[view], height, width)
                if y < 0 or z > farthest[view, y, x] * (1 + DEPTH_TOLERANCE):
                    continue
                votes += 1
                if z >= nearest[view, y, x] * (1 - DEPTH_TOLERANCE):
                    support += color_agrees(colors[row, column], least[view, y, x], most[view, y, x])
            score[row, column] = support / votes
