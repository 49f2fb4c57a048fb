"""How well a view's depths suit the other views, and the choice among several predictions of a view by it.

Groups of views overlap, so that the network predicts most views several times, each time beside other partners. Which
partners suit a pixel best is not known before; the other views tell it afterwards: photometric and geometric
consistency, as in PatchMatch stereo (Schönberger et al. 2016).
"""

from collections.abc import Sequence

import numpy as np

from ..inference.predictor import Prediction
from ..splats.gaussians import Gaussians
from ..views.batch import ViewBatch
from .agreement import Agreement
from .patches import PatchMatcher, window_mean

SOURCES = 4  # neighbours whose images and surfaces are compared
EQUAL = 1e-3  # ratings that differ by less decide nothing


class DepthRating:
    """Rates depths of a view by the images of its neighbours, and by the surfaces of all views that are asked.

    depth: z-depth of the surfaces of all views, float32 [views, height, width]. voters: for each view, the others that
    are asked, nearest first, as arrays of indices.
    """

    def __init__(self, depth: np.ndarray, views: ViewBatch, voters: list[np.ndarray]) -> None:
        self.agreement = Agreement(depth, views, voters)
        self.surfaces = self.agreement.surfaces
        self.matcher = PatchMatcher(views.images, self.surfaces)
        self.sources = [others[:SOURCES] for others in voters]

    def rate(self, view: int, depth: np.ndarray) -> np.ndarray:
        """How well each depth suits the other views, -1 to 2: ZNCC and the share of the votes, float32 [height, width].

        depth: z-depth of the view, float32 [height, width].
        """
        matches = self.matcher.score(view, depth, self.sources[view])
        return window_mean(matches + window_mean(self.agreement.score(view, depth)))

    def best(self, view: int, predictions: Sequence[Prediction]) -> Prediction:
        """The pixels of several predictions of a view that suit the other views best, as one prediction.

        predictions: that of the view's own group first, which is kept where no other one is better.
        """
        if len(predictions) == 1:
            return predictions[0]
        ratings = np.stack([self.rate(view, prediction.depth[0]) for prediction in predictions])
        ratings[0] += EQUAL
        return _merge(predictions, ratings.argmax(axis=0))


def _merge(predictions: Sequence[Prediction], chosen: np.ndarray) -> Prediction:
    """One prediction of a view from several, chosen [height, width] at each pixel by index."""
    pixels = np.arange(chosen.size)
    depth = np.stack([prediction.depth.ravel() for prediction in predictions])[chosen.ravel(), pixels]
    sets = [prediction.gaussians for prediction in predictions if prediction.gaussians is not None]
    gaussians = Gaussians.concatenate(sets).select(chosen.ravel() * chosen.size + pixels) if sets else None
    return Prediction(depth.reshape(predictions[0].depth.shape), gaussians, {}, predictions[0].cameras)
