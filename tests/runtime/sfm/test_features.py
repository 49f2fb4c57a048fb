"""Features lie where they are, and two cameras' tolerance is that of both."""

import cv2
import numpy as np
import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.sfm import estimate
from idesplat.runtime.sfm.estimate import UncalibratedImage
from idesplat.runtime.sfm.features import Features, extract_features


def dots(centres, sigma, height=180, width=220):
    """Soft dots, grey, with their centres in pixels whose own centres are at .5."""
    y, x = np.mgrid[:height, :width] + 0.5
    image = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2)) for cx, cy in centres)
    return np.rint(255 * np.minimum(image, 1)).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 6.0])
def test_features_have_no_offset(sigma):
    rng = np.random.default_rng(0)
    centres = np.array([(20 + 30 * i, 20 + 30 * j) for i in range(6) for j in range(5)]) + rng.random((30, 2))
    keypoints = extract_features(dots(centres, sigma)).keypoints
    off = np.array([keypoints[np.linalg.norm(keypoints - centre, axis=1).argmin()] - centre for centre in centres])
    assert np.abs(np.median(off, axis=0)).max() < 0.05  # a quarter of a pixel without the precise upscale


def test_features_of_a_mirrored_image_are_mirrored():
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.integers(0, 255, (160, 200), np.uint8), (0, 0), 3)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    keypoints = extract_features(image).keypoints
    mirrored = extract_features(np.ascontiguousarray(image[:, ::-1])).keypoints * (-1, 1) + (200, 0)
    apart = mirrored[np.linalg.norm(keypoints[:, None] - mirrored[None], axis=-1).argmin(axis=1)] - keypoints
    assert np.abs(np.median(apart, axis=0)).max() < 0.05


def test_the_tolerance_is_that_of_both_cameras(monkeypatch):
    features = Features(np.random.default_rng(0).random((50, 2)) * 100, np.eye(50, 128, dtype=np.float32))
    wide = UncalibratedImage("wide.png", 1600, 1200, features, 800.0)
    tele = UncalibratedImage("tele.png", 3200, 2400, features, 6400.0)
    seen = []

    def stop(first, second, tolerance):
        seen.append(tolerance)
        raise InputError("far enough")

    monkeypatch.setattr(estimate, "rotation_only_inlier_ratio", stop)
    for pair in ((wide, tele), (tele, wide), (wide, wide)):
        with pytest.raises(InputError, match="far enough"):
            estimate._two_cameras(*pair)
    assert seen == pytest.approx([(1.5 / 800 + 3 / 6400) / 2] * 2 + [1.5 / 800])
