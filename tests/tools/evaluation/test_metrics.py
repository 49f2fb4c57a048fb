"""PSNR, SSIM, LPIPS and AbsRel, held against scikit-image and against numbers by hand."""

import cv2
import numpy as np
import pytest
from idesplat.tools.evaluation import metrics
from idesplat.tools.evaluation.metrics import depth_measures, load_lpips, psnr, ssim
from idesplat.tools.training import losses
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

EVERYWHERE = np.ones((40, 56), bool)


def images(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A image with structure at several scales, and a worse one of the same thing."""
    rng = np.random.default_rng(seed)
    truth = sum(cv2.resize(rng.random((n, n, 3)), (56, 40), interpolation=cv2.INTER_CUBIC) for n in (3, 9, 40)) / 3
    image = cv2.GaussianBlur(truth, (5, 5), 1.2) + 0.05 * rng.standard_normal(truth.shape)
    return image.clip(0, 1), truth.clip(0, 1)


def skimage_ssim(image: np.ndarray, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """As the releases call it, and the map."""
    options = {"win_size": 11, "gaussian_weights": True, "data_range": 1.0, "channel_axis": 2}
    return structural_similarity(truth, image, full=True, **options)


@pytest.mark.parametrize("seed", range(4))
def test_psnr_and_ssim_against_scikit_image(seed: int) -> None:
    image, truth = images(seed)
    assert psnr(image, truth, EVERYWHERE) == pytest.approx(peak_signal_noise_ratio(truth, image, data_range=1.0))
    expected, _ = skimage_ssim(image, truth)
    assert 0.2 < expected < 0.95
    assert ssim(image, truth, EVERYWHERE) == pytest.approx(expected, abs=1e-9)
    single = ssim(image.astype(np.float32), truth.astype(np.float32), EVERYWHERE)
    assert single == pytest.approx(skimage_ssim(image.astype(np.float32), truth.astype(np.float32))[0], abs=1e-5)


def test_only_valid_pixels_count() -> None:
    image, truth = images(5)
    valid = EVERYWHERE.copy()
    valid[:, 50:] = False
    valid[3, 2] = False
    spoilt = np.where(valid[..., None], image, 7.0)
    assert psnr(spoilt, truth, valid) == pytest.approx(-10 * np.log10(np.mean((image - truth)[valid] ** 2)))
    _, similarity = skimage_ssim(image, truth)
    whole = np.zeros_like(valid)
    whole[5:35, 5:45] = True  # windows inside of the image and left of column 50 ...
    whole[5:9, 5:8] = False  # ... and off the single pixel
    assert ssim(spoilt, truth, valid) == pytest.approx(similarity[whole].mean(), abs=1e-9)
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


@pytest.mark.parametrize("package", ["torch", "lpips"])
def test_lpips_is_left_out_in_one_line(
    package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda name: None if name == package else object())
    assert load_lpips() is None
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1 and package in warning


def test_lpips_sees_pictures_whose_invalid_pixels_are_true(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda name: object())
    monkeypatch.setattr(losses, "load_perceptual", lambda: lambda x, y: (x - y).abs().sum() + x.shape[1])
    lpips = load_lpips()
    assert lpips is not None
    truth = np.zeros((4, 5, 3))
    valid = np.ones((4, 5), bool)
    valid[0] = False
    assert lpips(truth + 1, truth, valid) == 3 * 15 + 3  # [1, 3, height, width]
