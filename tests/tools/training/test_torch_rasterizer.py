"""The differentiable rasteriser: gsplat's reference images, and gradients against finite differences."""

from math import factorial, pi, sqrt
from pathlib import Path

import numpy as np
import pytest
import torch
from idesplat.runtime.rendering.types import MIN_ALPHA
from idesplat.tools.training.rasterizer import rasterize
from torch import Tensor

DATA = Path(__file__).parent.parent.parent / "data"
NAMES = ("means", "quats", "scales", "opacities", "sh")
MAX_FLIPPED = 1e-4  # share of the values that a fragment at MIN_ALPHA may change in float32


def reference(case: str) -> dict[str, np.ndarray]:
    return dict(np.load(DATA / f"raster-{case}" / "reference.npz"))


def render_reference(arrays: dict[str, np.ndarray], gaussians: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """The reference's view of `gaussians`, in their float type."""
    viewmat, camera, background = (
        torch.from_numpy(arrays[name]).to(gaussians[0].dtype) for name in ("viewmat", "K", "background")
    )
    return rasterize(*gaussians, viewmat, camera, int(arrays["width"]), int(arrays["height"]), background)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-3), (torch.float64, 1e-6)])
@pytest.mark.parametrize("case", ["random", "feedforward"])
def test_matches_gsplat(case: str, dtype: torch.dtype, tolerance: float) -> None:
    """float64 is limited by the reference, which is stored in float32.

    In float32 the rounding of the processor decides on fragments whose alpha is MIN_ALPHA within rounding: few pixels,
    which such a fragment changes by MIN_ALPHA of the range of values at most.
    """
    arrays = reference(case)
    images = render_reference(arrays, [torch.from_numpy(arrays[name]).to(dtype) for name in NAMES])
    for name, ours in zip(("rgb", "alpha", "depth"), images, strict=True):
        assert ours.dtype == dtype
        error = np.abs(ours.numpy() - arrays[name])
        if dtype == torch.float32:
            assert (error > tolerance).mean() < MAX_FLIPPED, name
            assert error.max() < tolerance + MIN_ALPHA * np.ptp(arrays[name]), name
        else:
            assert error.max() < tolerance, name


def small_scene(seed: int, degree: int) -> list[Tensor]:
    """Ten overlapping splats of all sizes before a camera at the origin, float64, with gradients."""
    rng = np.random.default_rng(seed)
    count = 10
    means = rng.uniform((-1, -1, 1.5), (1, 1, 4), (count, 3))
    parts = [
        means,
        rng.normal(0, 1, (count, 4)),
        np.exp(rng.uniform(-4, -0.7, (count, 3))),
        rng.uniform(0.1, 0.95, count),
        rng.normal(0.5, 0.5, (count, (degree + 1) ** 2, 3)),
    ]
    return [torch.from_numpy(part).requires_grad_() for part in parts]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "degree"), [(0, 0), (1, 1), (2, 3)])
def test_gradients_match_finite_differences(seed: int, degree: int) -> None:
    """For every input: Gaussians, camera and background, through colour, alpha and depth."""
    camera = torch.tensor([[14.0, 0, 6.2], [0, 13.0, 5.1], [0, 0, 1]], dtype=torch.float64, requires_grad=True)
    viewmat = torch.eye(4, dtype=torch.float64, requires_grad=True)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64, requires_grad=True)

    def render(*inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return rasterize(*inputs[:7], 12, 10, inputs[7])

    inputs = (*small_scene(seed, degree), viewmat, camera, background)
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=False)


def test_float32_gradients_match_float64() -> None:
    """The backward pass divides by 1 - alpha for each splat; thousands of divisions must stay accurate."""
    arrays = reference("feedforward")
    gradients = []
    for dtype in (torch.float32, torch.float64):
        gaussians = [torch.from_numpy(arrays[name]).to(dtype).requires_grad_() for name in NAMES]
        rgb, alpha, depth = render_reference(arrays, gaussians)
        (rgb.square().sum() + alpha.sum() + 0.1 * depth.square().sum()).backward()
        gradients.append([part.grad.double() for part in gaussians])
    for name, ours, exact in zip(NAMES, *gradients, strict=True):
        assert exact.norm() > 0
        assert (ours - exact).norm() < 1e-3 * exact.norm(), name


def test_compositing_ends_at_low_transmittance() -> None:
    """Splats behind transmittance 1e-4 contribute nothing and get no gradient."""
    count = 6  # alpha 0.99 each: the third would leave 1e-6
    means = torch.zeros(count, 3)
    means[:, 2] = torch.arange(count, 0, -1)  # given back to front
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    opacities = torch.ones(count, requires_grad=True)
    sh = torch.ones(count, 1, 3, requires_grad=True)
    camera = torch.tensor([[10.0, 0, 4.5], [0, 10.0, 4.5], [0, 0, 1]])
    scales = torch.full((count, 3), 100.0)
    rgb, alpha, depth = rasterize(means, quats, scales, opacities, sh, torch.eye(4), camera, 9, 9, torch.zeros(3))
    # Rounding decides whether the second splat leaves more than 1e-4; the third never does.
    assert alpha[4, 4].item() in (pytest.approx(0.99), pytest.approx(0.9999))
    assert depth[4, 4].item() < 0.99 * 1 + 0.0099 * 2 + 1e-4
    rgb.sum().backward()
    assert (sh.grad[:4] == 0).all()
    assert (sh.grad[5] > 0).all()
    assert (opacities.grad == 0).all()  # alpha is held at 0.99


def test_no_visible_gaussian_gives_the_background() -> None:
    background = torch.tensor([0.1, 0.2, 0.3])
    camera = torch.tensor([[10.0, 0, 4], [0, 10.0, 3], [0, 0, 1]])
    behind = torch.tensor([[0.0, 0, -2]], requires_grad=True)
    for means in (torch.zeros(0, 3), behind):
        count = len(means)
        parts = (torch.ones(count, 4), torch.ones(count, 3), torch.ones(count), torch.ones(count, 4, 3))
        rgb, alpha, depth = rasterize(means, *parts, torch.eye(4), camera, 8, 6, background)
        assert torch.equal(rgb, background.expand(6, 8, 3))
        assert not alpha.any() and not depth.any()
    rgb.sum().backward()
    assert torch.equal(behind.grad, torch.zeros(1, 3))


def sh_by_definition(degree: int, direction: np.ndarray) -> list[float]:
    """3DGS's SH basis by definition: real, with the Condon-Shortley phase, orders -l to l."""
    x, y, z = direction
    azimuth = np.arctan2(y, x)
    values = []
    for order in range(-degree, degree + 1):
        m = abs(order)
        polynomial = np.polynomial.legendre.Legendre.basis(degree).deriv(m) if m else None
        legendre = (polynomial or np.polynomial.legendre.Legendre.basis(degree))(z) * (-sqrt(1 - z * z)) ** m
        scale = sqrt((2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m))
        wave = 1.0 if m == 0 else sqrt(2) * (np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth))
        values.append(scale * legendre * wave)
    return values


def test_sh_up_to_degree_three_follow_their_definition() -> None:
    """One splat on the axis of a camera with random direction, for each coefficient alone."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        direction = rng.normal(0, 1, 3)
        direction /= np.linalg.norm(direction)
        expected = np.concatenate([sh_by_definition(degree, direction) for degree in range(4)])
        right = np.cross(direction, [0.3, 0.5, 0.7])
        right /= np.linalg.norm(right)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(np.stack([right, np.cross(direction, right), direction]))
        camera = torch.tensor([[10.0, 0, 1.5], [0, 10.0, 1.5], [0, 0, 1]], dtype=torch.float64)
        for coefficient in range(16):
            sh = torch.zeros(1, 16, 3, dtype=torch.float64)
            sh[0, coefficient] = 0.2
            rgb, alpha, _ = rasterize(
                2 * torch.from_numpy(direction)[None],
                torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
                torch.full((1, 3), 0.5, dtype=torch.float64),
                torch.tensor([0.9], dtype=torch.float64),
                sh,
                viewmat,
                camera,
                3,
                3,
                torch.zeros(3, dtype=torch.float64),
            )
            colour = (rgb[1, 1, 0] / alpha[1, 1]).item()
            assert colour == pytest.approx(0.2 * expected[coefficient] + 0.5, abs=1e-9), coefficient
