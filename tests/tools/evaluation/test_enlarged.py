"""Renderings of small frames, at the place that they have in larger frames of the same camera."""

import numpy as np
from idesplat.tools.evaluation.captures.enlarged import enlarge
from idesplat.tools.evaluation.cases import PosedImages


def frame(height: int, width: int, K: np.ndarray) -> PosedImages:
    """One view of the camera K, in pixels, whose colours are the directions (x, y) of its pixels' rays, scaled."""
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.zeros_like(x)]) + 0.5
    normalised = K / np.array([[width], [height], [1]])
    valid = np.ones((1, height, width), bool)
    return PosedImages(["a"], rays[None].astype(np.float32), np.eye(4)[None], normalised[None], valid)


def test_an_enlarged_image_shows_each_ray_at_its_pixel_of_the_larger_frame() -> None:
    small = frame(32, 32, np.array([[40.0, 0, 17], [0, 40, 15], [0, 0, 1]]))
    large = frame(48, 64, np.array([[60.0, 0, 33], [0, 60, 23], [0, 0, 1]]))
    enlarged, inside = enlarge(small.image(0), small, large)
    assert enlarged.shape == (48, 64, 3)
    # OpenCV's bicubic kernel is off by up to .07 pixels on a ramp; a wrong pixel centre would be off by .17 and more.
    np.testing.assert_allclose(enlarged[inside], large.image(0)[inside], atol=0.07 / 40)
    # The centres of the outermost small pixels lie at x = 8.25 and 54.75 of the large frame; its rows end at 48.
    assert inside.any(axis=0).nonzero()[0].tolist() == list(range(8, 55))
    assert inside.any(axis=1).nonzero()[0].tolist() == list(range(1, 48))


def test_only_valid_pixels_are_compared() -> None:
    K = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    small = frame(32, 32, K)
    small.valid[0, :, :16] = False
    _, inside = enlarge(small.image(0), small, frame(32, 32, K))
    assert not inside[:, :16].any() and inside[:, 16:].all()
