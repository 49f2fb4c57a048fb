"""Depth maps corrected by stereo matching, once all views are there: the network sees two or three at a time.

A pixel has few candidates: its depth, a little less and more, and the depths of the neighbours' surfaces there. It
takes the one whose patch matches the neighbours' images best (zero-mean normalised cross-correlation, ZNCC) and that
most views agree with: photometric and geometric consistency, as in PatchMatch stereo (Schönberger et al. 2016).
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from ..inference.predictor import Prediction
from ..splats.surfaces import Surfaces, project_to_pixel
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from ..views.batch import ViewBatch
from .agreement import SQUARE, Agreement

MIN_VIEWS = 3  # the network saw both of two at once
SOURCES = 4  # neighbours whose images and surfaces are compared
STEPS = (0.99, 1.01)  # candidates, times the depth; the network's median error is 0.8 %
WINDOW = 5  # pixels a side of a patch, and of the pixels that choose together
NOISE = 1e-3  # variance of a patch, of colours in [0, 1], at which ZNCC counts half: plain surfaces match everywhere
# By which a candidate must be better than the depth as predicted. With three views, few votes speak against a wrong
# match.
OWN_MARGIN, OWN_MARGIN_OF_THREE = 0.1, 0.2
OUTSIDE = np.nan  # ZNCC of a patch that a view does not see


def correct_depths(prediction: Prediction, views: ViewBatch, voters: list[np.ndarray]) -> Prediction:
    """The prediction with its depths, and its Gaussians along their rays, moved to where the views match.

    voters: for each view, the others that are asked, nearest first, as arrays of indices. Fewer than MIN_VIEWS views
    stay as they are.
    """
    count = len(views.names)
    if count < MIN_VIEWS:
        return prediction
    margin = OWN_MARGIN_OF_THREE if count == 3 else OWN_MARGIN
    agreement = Agreement(prediction.depth, views, voters)
    matcher = Matcher(views.images, agreement.surfaces)

    def rate(view: int, depth: np.ndarray) -> np.ndarray:
        matches = matcher.score(view, depth, voters[view][:SOURCES])
        return _mean(matches + _mean(agreement.score(view, depth)))

    def correct(view: int) -> np.ndarray:
        depth = agreement.surfaces.depth[view]
        best = rate(view, depth) + margin
        for candidate in _candidates(agreement, view, voters[view][:SOURCES]):
            score = rate(view, candidate)
            depth, best = np.where(score > best, candidate, depth), np.maximum(score, best)
        return depth

    return _at_depth(prediction, np.stack(map_in_threads(correct, count)), views.extrinsics)


class Matcher:
    """The views' images in grey, with the mean and variance of every patch.

    images: RGB in [0, 1], [views, 3, height, width]. surfaces: have the views' cameras.
    """

    def __init__(self, images: np.ndarray, surfaces: Surfaces) -> None:
        self.surfaces = surfaces
        self.images = [np.ascontiguousarray(image.mean(axis=0), np.float32) for image in images]
        self.means = [_mean(image) for image in self.images]
        self.variances = [
            _mean(np.square(image)) - np.square(mean) for image, mean in zip(self.images, self.means, strict=True)
        ]

    def score(self, view: int, depth: np.ndarray, sources: np.ndarray) -> np.ndarray:
        """The mean ZNCC with the better half of the sources that see a pixel, 0 without any, float32 [height, width].

        A surface may be hidden from some of them. depth: z-depth of the view, float32 [height, width].
        """
        all_scores = np.stack([self._zncc(view, depth, source) for source in sources])
        half = np.empty(depth.shape, np.float32)
        _mean_of_better_half(np.sort(all_scores, axis=0)[::-1], half)
        return half

    def _zncc(self, view: int, depth: np.ndarray, source: int) -> np.ndarray:
        """ZNCC of a view's patches with those of another image at their depth, OUTSIDE it or -1 to 1."""
        s = self.surfaces
        to_source = s.viewmats[source] @ s.extrinsics[view]
        from_pixels = s.Ks[source] @ to_source[:3, :3] @ np.linalg.inv(s.Ks[view])
        image, seen = np.empty_like(depth), np.empty(depth.shape, np.bool_)
        _sample(depth, from_pixels, s.Ks[source] @ to_source[:3, 3], self.images[source], image, seen)
        mean = _mean(image)
        variance = np.maximum(_mean(np.square(image)) - np.square(mean), 0)
        covariance = _mean(self.images[view] * image) - mean * self.means[view]
        zncc = covariance / np.sqrt((variance + NOISE) * (self.variances[view] + NOISE))
        return np.where(seen, zncc, np.float32(OUTSIDE))


def _candidates(agreement: Agreement, view: int, sources: np.ndarray) -> Iterator[np.ndarray]:
    """Other depth maps for a view than its own, float32 [height, width]."""
    surfaces = agreement.surfaces
    own = surfaces.depth[view]
    for step in STEPS:
        yield own * np.float32(step)
    for source in sources:
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


def _mean(image: np.ndarray) -> np.ndarray:
    """The mean over the window around each pixel."""
    return cv2.blur(image, (WINDOW, WINDOW))


@compiled()
def _sample(
    depth: np.ndarray,  # [height, width]
    from_pixels: np.ndarray,  # [3, 3], from a pixel times its depth to one of the source
    offset: np.ndarray,  # [3]
    source: np.ndarray,  # [height, width]
    image: np.ndarray,  # [height, width]
    seen: np.ndarray,  # [height, width]
) -> None:
    """The source's image as the view would see it at its depth, bilinear; seen: where the source sees the point."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            x, y, z = column + 0.5, row + 0.5, depth[row, column]
            across = (from_pixels[0, 0] * x + from_pixels[0, 1] * y + from_pixels[0, 2]) * z + offset[0]
            down = (from_pixels[1, 0] * x + from_pixels[1, 1] * y + from_pixels[1, 2]) * z + offset[1]
            away = (from_pixels[2, 0] * x + from_pixels[2, 1] * y + from_pixels[2, 2]) * z + offset[2]
            u, v = across / away, down / away
            inside = away > 0 and 0.5 <= u < width - 0.5 and 0.5 <= v < height - 0.5
            seen[row, column] = inside
            image[row, column] = _bilinear(source, u, v) if inside else 0


@compiled()
def _bilinear(image: np.ndarray, x: float, y: float) -> float:
    """The value of a map [height, width] at a position in pixels, whose centres are at .5; beside them the border's."""
    height, width = image.shape
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    left, top = min(int(u), width - 2), min(int(v), height - 2)
    right, below = u - left, v - top
    upper = image[top, left] * (1 - right) + image[top, left + 1] * right
    lower = image[top + 1, left] * (1 - right) + image[top + 1, left + 1] * right
    return upper * (1 - below) + lower * below


@compiled()
def _mean_of_better_half(ordered: np.ndarray, half: np.ndarray) -> None:
    """The mean of the better half of the numbers [sources, height, width], greatest first after those that are NaN."""
    sources, height, width = ordered.shape
    for row in range(height):
        for column in range(width):
            first = 0
            while first < sources and np.isnan(ordered[first, row, column]):
                first += 1
            count = (sources - first + 1) // 2
            total = 0.0
            for place in range(first, first + count):
                total += ordered[place, row, column]
            half[row, column] = total / max(count, 1)


@compiled()
def _project(points: np.ndarray, viewmat: np.ndarray, K: np.ndarray, depth: np.ndarray) -> None:
    """Lower a view's depth [height, width] to that of the points [height, width, 3] that fall on its pixels."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            z, y, x = project_to_pixel(points[row, column], viewmat, K, height, width)
            if y >= 0 and z < depth[y, x]:
                depth[y, x] = z
