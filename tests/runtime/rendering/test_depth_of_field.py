"""Depth of field against a lens that is sampled: the mean of pinhole renderings from points of the lens.

Each pinhole's principal point is shifted, so that the plane in focus has one image from all of them.
"""

from dataclasses import fields, replace
from math import pi, sqrt

import numpy as np
import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.errors import InputError
from idesplat.runtime.rendering.render import autofocus, render, render_view
from idesplat.runtime.splats.gaussians import Gaussians

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
CAMERA = Camera("view", WIDTH, HEIGHT, K, np.eye(4))
APERTURE, FOCUS = 0.3, 2.5
NEARER, FARTHER = 1.5, 5.0  # discs of 7.2 and 5.4 pixels
LENS_SAMPLES = 128


def sampled_lens(gaussians: Gaussians, aperture: float = APERTURE, focus: float = FOCUS, K: np.ndarray = K) -> tuple:
    """RGB and alpha through a lens of this diameter, float64."""
    rgb, alpha = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
    for x, y in aperture * unit_disc(LENS_SAMPLES):
        pose, shifted = np.eye(4), K.copy()
        pose[:2, 3] = x, y
        shifted[:2, 2] += K[0, 0] * x / focus, K[1, 1] * y / focus
        rendering = render_view(gaussians, pose, shifted, WIDTH, HEIGHT)
        rgb += rendering.rgb / LENS_SAMPLES
        alpha += rendering.alpha / LENS_SAMPLES
    return rgb, alpha


def unit_disc(count: int) -> np.ndarray:
    """Points [count, 2] spread evenly over a disc of diameter 1, on Vogel's spiral."""
    index = np.arange(count) + 0.5
    angle = index * pi * (3 - sqrt(5))
    return 0.5 * np.sqrt(index / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def wall(z: float, count: int, pixels: float, opacities: tuple[float, float], share: float = 1.3) -> Gaussians:
    """Gaussians of random colours about the depth z, some `pixels` large, over this share of the image's sides."""
    rng = np.random.default_rng(1)
    half = np.array([WIDTH, HEIGHT]) / 2 / FOCAL * z * share
    means = np.concatenate([rng.uniform(-half, half, (count, 2)), z * rng.normal(1, 0.01, (count, 1))], axis=1)
    return Gaussians(
        means=means.astype(np.float32),
        scales=(np.exp(rng.normal(0, 0.3, (count, 3))) * pixels * z / FOCAL).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacities=rng.uniform(*opacities, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def together(*parts: Gaussians) -> Gaussians:
    names = [field.name for field in fields(Gaussians)]
    return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def dot(x: float, y: float, z: float, pixels: float, opacity: float = 0.9) -> Gaussians:
    scale = pixels * z / FOCAL
    return Gaussians(
        np.float32([[x, y, z]]),
        np.full((1, 3), scale, np.float32),
        np.float32([[1, 0, 0, 0]]),
        np.float32([opacity]),
        np.zeros((1, 1, 3), np.float32),
    )


def through_lens(gaussians: Gaussians, aperture: float = APERTURE, focus: float = FOCUS, K: np.ndarray = K) -> tuple:
    rendering = render_view(gaussians, np.eye(4), K, WIDTH, HEIGHT, aperture=aperture, focus=focus)
    return rendering.rgb, rendering.alpha


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    return -10 * np.log10(np.mean((image - reference) ** 2))


SPARSE = (200, 1.5, (0.3, 0.9))  # a fifth of the image covered
DENSE = (3000, 1.5, (0.3, 0.9))  # five Gaussians at every pixel


@pytest.mark.parametrize(
    ("z", "texture", "least", "gain"),
    [
        pytest.param(FOCUS, SPARSE, 70, 0, id="in focus, sparse"),
        pytest.param(FOCUS, DENSE, 70, 0, id="in focus, dense"),
        pytest.param(NEARER, SPARSE, 40, 15, id="nearer, sparse"),
        pytest.param(NEARER, DENSE, 35, 10, id="nearer, dense"),
        pytest.param(FARTHER, SPARSE, 40, 15, id="farther, sparse"),
        pytest.param(FARTHER, DENSE, 35, 10, id="farther, dense"),
    ],
)
def test_a_wall_is_that_of_a_sampled_lens(z: float, texture: tuple, least: float, gain: float) -> None:
    """PSNR in dB; gain: over the pinhole's image. What remains is the disc's shape, and overlaps of Gaussians."""
    gaussians = wall(z, *texture)
    expected, expected_alpha = sampled_lens(gaussians)
    rgb, alpha = through_lens(gaussians)
    assert psnr(rgb, expected) >= least
    assert psnr(rgb, expected) - psnr(through_lens(gaussians, aperture=0)[0], expected) >= gain
    assert alpha.mean() == pytest.approx(expected_alpha.mean(), abs=0.005)


def test_a_scene_of_three_depths_is_that_of_a_sampled_lens() -> None:
    """Faint Gaussians nearer than the focus, in focus and beyond, one behind the other."""
    parts = [wall(z, 300, 1.5, (0.2, 0.6)) for z in (NEARER, FOCUS, FARTHER)]
    gaussians = together(*parts)
    expected, expected_alpha = sampled_lens(gaussians)
    rgb, alpha = through_lens(gaussians)
    assert psnr(rgb, expected) >= 40
    assert np.abs(alpha - expected_alpha).max() <= 0.1


def test_an_opaque_silhouette_is_near_that_of_a_sampled_lens() -> None:
    """The worst case: Gaussians that hide each other cover more beyond their edge than the lens sees of them."""
    gaussians = together(wall(NEARER, 1500, 1.5, (0.9, 1), share=0.5), wall(FOCUS, 4000, 1.5, (0.9, 1)))
    expected, _ = sampled_lens(gaussians)
    found = psnr(through_lens(gaussians)[0], expected)
    assert found >= 32
    assert found - psnr(through_lens(gaussians, aperture=0)[0], expected) >= 7


@pytest.mark.parametrize("z", [NEARER, FARTHER])
def test_the_variance_of_one_gaussian_grows_by_the_discs(z: float) -> None:
    """With pixels that are not square: moments of the image, the disc being where the lens's points see the centre."""
    K = np.array([[90.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    aperture = 0.6
    gaussians = dot(0.1, -0.05, z, pixels=4)
    lens = aperture * unit_disc(100_000)
    seen = K.diagonal()[:2] * ((gaussians.means[0, :2] - lens) / z + lens / FOCUS)  # [points, 2]
    (before, spread_before), (after, spread_after) = (
        moments(through_lens(gaussians, aperture=size, K=K)[1]) for size in (0, aperture)
    )
    assert after == pytest.approx(before, rel=1e-3)  # the light is spread, not lost
    in_focus = (np.float64(gaussians.scales[0, :2]) * K.diagonal()[:2] / z) ** 2 + 0.3
    # Both images end at the same number of standard deviations, so the same share of the variance is missing.
    np.testing.assert_allclose(spread_after / spread_before, 1 + seen.var(axis=0) / in_focus, rtol=1e-2)


def moments(alpha: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of an image, and variances along x and y of what it shows."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)
    weights = alpha.astype(np.float64).ravel()
    centre = weights @ pixels / weights.sum()
    return weights.sum(), weights @ (pixels - centre) ** 2 / weights.sum()


def test_without_an_aperture_it_is_a_pinhole_to_the_bit() -> None:
    gaussians = together(wall(NEARER, *SPARSE), wall(FARTHER, *DENSE))
    expected = render_view(gaussians, np.eye(4), K, WIDTH, HEIGHT)
    for focus in (None, 1e-3, FOCUS, np.inf):
        rendering = render_view(gaussians, np.eye(4), K, WIDTH, HEIGHT, aperture=0, focus=focus)
        for ours, theirs in zip(rendering, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_the_plane_in_focus_is_that_of_a_pinhole_to_the_bit() -> None:
    gaussians = wall(FOCUS, *DENSE)
    gaussians.means[:, 2] = FOCUS
    np.testing.assert_array_equal(through_lens(gaussians)[0], through_lens(gaussians, aperture=0)[0])


def test_what_is_beside_the_image_is_blurred_into_it() -> None:
    """The Gaussian's centre is left of the image, and its disc reaches in, as in an image that continues there."""
    outside, margin = 3, 10  # columns
    gaussians = dot((-outside - WIDTH / 2) * NEARER / FOCAL, 0, NEARER, pixels=0.3)
    assert not through_lens(gaussians, aperture=0)[1].any()
    _, alpha = through_lens(gaussians)
    wide = K.copy()
    wide[0, 2] += margin
    lens = {"aperture": APERTURE, "focus": FOCUS}
    continued = render_view(gaussians, np.eye(4), wide, margin + WIDTH, HEIGHT, **lens).alpha
    assert alpha[HEIGHT // 2, 0] > 0
    np.testing.assert_allclose(alpha, continued[:, margin:], atol=1e-6)


def test_small_gaussians_far_out_of_focus_do_not_vanish() -> None:
    """Each is spread over hundreds of times its area, so that its alpha falls below MIN_ALPHA."""
    gaussians = wall(FARTHER, 20_000, 0.1, (0.5, 0.9))
    aperture = 2.0  # a disc of 36 pixels
    _, expected = sampled_lens(gaussians, aperture=aperture)
    _, alpha = through_lens(gaussians, aperture=aperture)
    middle = slice(HEIGHT // 3, -HEIGHT // 3), slice(WIDTH // 3, -WIDTH // 3)
    np.testing.assert_allclose(alpha[middle], expected[middle], atol=0.05)


# ---- focus


DEPTH_SPREAD = 0.03  # three standard deviations of a wall's depths


def test_autofocus_is_the_median_depth_in_the_middle() -> None:
    shown = together(wall(2.0, 2000, 2.0, (0.9, 1.0), share=0.4), wall(6.0, 4000, 2.0, (0.9, 1.0)))
    assert autofocus(shown, CAMERA) == pytest.approx(2.0, rel=DEPTH_SPREAD)
    outside = replace(shown, means=shown.means + np.float32([1.2, 0, 0]))
    assert autofocus(outside, CAMERA) == pytest.approx(6.0, rel=DEPTH_SPREAD)


def test_autofocus_needs_something_in_the_middle() -> None:
    with pytest.raises(InputError, match="camera view has nothing in the middle of its image"):
        autofocus(dot(0.6, 0.4, 2.0, pixels=2), CAMERA)


def test_all_cameras_have_the_focus_of_the_first() -> None:
    gaussians = wall(FARTHER, *DENSE)
    farther = Camera("second", WIDTH, HEIGHT, K, np.eye(4))
    farther.extrinsics[2, 3] = 2.0
    first, second = render(gaussians, [CAMERA, farther], aperture=APERTURE)
    focus = autofocus(gaussians, CAMERA)
    for camera, rendering in ((CAMERA, first), (farther, second)):
        expected = render_view(gaussians, camera.extrinsics, K, WIDTH, HEIGHT, aperture=APERTURE, focus=focus)
        np.testing.assert_array_equal(rendering.rgb, expected.rgb)
    (given,) = render(gaussians, [farther], aperture=APERTURE, focus=3.0)
    assert psnr(given.rgb, second.rgb) > psnr(second.rgb, first.rgb)


def test_a_focus_that_is_no_distance() -> None:
    with pytest.raises(InputError, match="focus is far, expected a z-depth in world units, or auto"):
        next(render(dot(0, 0, 2.0, 1), [CAMERA], aperture=0.1, focus="far"))
