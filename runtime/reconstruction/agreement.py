"""How many views agree with a depth: those whose surface is there, in a colour that fits."""

import cv2
import numpy as np

from ..geometry.consistency import DEPTH_TOLERANCE
from ..splats.points import unproject
from ..splats.surfaces import Surfaces, color_agrees, project_to_pixel
from ..system.compilation import compiled
from ..views.batch import ViewBatch

# Votes that every depth has beside those of the views, half of one for it: few votes decide less than many.
PRIOR_VOTES, PRIOR_SUPPORT = 2.0, 0.5
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
