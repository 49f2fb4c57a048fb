"""How well the patches of views match at a depth: zero-mean normalised cross-correlation (ZNCC)."""

import cv2
import numpy as np

from ..splats.surfaces import Surfaces
from ..system.compilation import compiled

WINDOW = 5  # pixels a side of a patch, and of the pixels that choose together: neighbours are mostly of one surface
NOISE = 1e-3  # variance of a patch, of colours in [0, 1], at which ZNCC counts half: plain surfaces match everywhere
OUTSIDE = np.nan  # ZNCC of a patch that a view does not see


def window_mean(image: np.ndarray) -> np.ndarray:
    """The mean over the window around each pixel."""
    return cv2.blur(image, (WINDOW, WINDOW))


class PatchMatcher:
    """The views' images in grey, with the mean and variance of every patch.

    images: RGB in [0, 1], [views, 3, height, width]. surfaces: have the views' cameras.
    """

    def __init__(self, images: np.ndarray, surfaces: Surfaces) -> None:
        self.surfaces = surfaces
        self.images = [np.ascontiguousarray(image.mean(axis=0), np.float32) for image in images]
        self.means = [window_mean(image) for image in self.images]
        self.variances = [
            window_mean(np.square(image)) - np.square(mean) for image, mean in zip(self.images, self.means, strict=True)
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
        mean = window_mean(image)
        variance = np.maximum(window_mean(np.square(image)) - np.square(mean), 0)
        covariance = window_mean(self.images[view] * image) - mean * self.means[view]
        zncc = covariance / np.sqrt((variance + NOISE) * (self.variances[view] + NOISE))
        return np.where(seen, zncc, np.float32(OUTSIDE))


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
