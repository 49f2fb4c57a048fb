"""The kernels of refinement: gsplat's reference images, gradients against PyTorch and finite differences."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from idesplat.runtime.refinement import rasterizer as rasterizer_module
from idesplat.runtime.refinement.losses import photometric_loss
from idesplat.runtime.refinement.poses import move_world
from idesplat.runtime.refinement.rasterizer import GradientRasterizer, Parameters, Target
from idesplat.tools.training.rasterizer import rasterize

DATA = Path(__file__).parents[2] / "data"
GROUPS = {"means": slice(0, 3), "quats": slice(3, 7), "log_scales": slice(7, 10), "logits": slice(10, 11)}


def random_parameters(seed: int, count: int, degree: int, dtype: type = np.float32) -> Parameters:
    rng = np.random.default_rng(seed)
    return Parameters(
        (rng.normal(size=(count, 3)) * (1, 1, 0.8) + (0, 0, 4)).astype(dtype),
        rng.normal(size=(count, 4)).astype(dtype),
        np.log(rng.uniform(0.02, 0.2, (count, 3))).astype(dtype),
        rng.normal(size=count).astype(dtype),
        (rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3).astype(dtype),
    )


def side_view(width: int = 48, height: int = 40) -> Target:
    viewmat = np.eye(4)
    viewmat[:3, 3] = 0.1, -0.2, 0.3
    return Target(viewmat, np.array([[40.0, 0, width / 2], [0, 42, height / 2], [0, 0, 1]]), width, height)


@pytest.mark.parametrize("case", ["random", "feedforward"])
def test_renders_as_gsplat_does(case: str) -> None:
    arrays = dict(np.load(DATA / f"raster-{case}" / "reference.npz"))
    opacities = arrays["opacities"].astype(np.float64).clip(1e-6, 1 - 1e-7)
    parameters = Parameters(
        *(np.ascontiguousarray(arrays[name], np.float32) for name in ("means", "quats")),
        np.log(arrays["scales"]).astype(np.float32),
        np.log(opacities / (1 - opacities)).astype(np.float32),
        np.ascontiguousarray(arrays["sh"], np.float32),
    )
    target = Target(
        arrays["viewmat"].astype(np.float64),
        arrays["K"].astype(np.float64),
        int(arrays["width"]),
        int(arrays["height"]),
    )
    done = GradientRasterizer(parameters).forward(target)
    rgb = done.rgb + done.transmittance[..., None] * arrays["background"]
    np.testing.assert_allclose(rgb, arrays["rgb"], rtol=0, atol=1e-3)
    np.testing.assert_allclose(1 - done.transmittance, arrays["alpha"], rtol=0, atol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_are_those_of_the_rasteriser_in_pytorch(degree: int) -> None:
    check_gradients(random_parameters(degree, 300, degree), side_view())


def test_gradients_with_little_room_for_fragments(monkeypatch: pytest.MonkeyPatch) -> None:
    """The room of a band is enlarged while the band is composited."""
    monkeypatch.setattr(rasterizer_module, "FIRST_FRAGMENTS", 1)
    check_gradients(random_parameters(1, 300, 1), side_view())


def test_gradients_behind_a_wall_that_stops_all_light() -> None:
    """A band ends before its last entries, which get no gradient."""
    parameters = random_parameters(1, 300, 1)
    wall = np.arange(8)
    parameters.means[wall] = np.stack([0.0 * wall, 0.0 * wall, 0.5 + 0.1 * wall], axis=1)
    parameters.log_scales[wall] = np.log([8.0, 8.0, 0.01])
    parameters.quats[wall] = 1, 0, 0, 0
    parameters.logits[wall] = 2  # opacity 0.88: after four, 2e-4 of the light is left; a fifth would leave too little
    parameters.means[len(wall) :, 2] = np.maximum(parameters.means[len(wall) :, 2], 1.5)
    gradients = check_gradients(parameters, side_view())
    assert (gradients != 0).any(axis=1).nonzero()[0].tolist() == [0, 1, 2, 3]


def check_gradients(parameters: Parameters, target: Target) -> np.ndarray:
    """Compare rendering and gradients with PyTorch's; ours, [gaussians, columns]."""
    rng = np.random.default_rng(7)
    for_rgb = rng.normal(size=(target.height, target.width, 3)).astype(np.float32)
    for_light = rng.normal(size=(target.height, target.width)).astype(np.float32)
    rasterizer = GradientRasterizer(parameters)
    done = rasterizer.forward(target)
    ours = rasterizer.parameter_gradients(done, rasterizer.backward(done, for_rgb, for_light))

    p = parameters
    tensors = [
        torch.from_numpy(array.astype(np.float64)).requires_grad_()
        for array in (p.means, p.quats, p.log_scales, p.logits, p.sh)
    ]
    means, quats, log_scales, logits, sh = tensors
    camera = torch.from_numpy(target.viewmat), torch.from_numpy(target.K), target.width, target.height
    rgb, alpha, _ = rasterize(
        means, quats, log_scales.exp(), logits.sigmoid(), sh, *camera, torch.zeros(3, dtype=torch.float64)
    )
    np.testing.assert_allclose(done.rgb, rgb.detach().numpy(), rtol=0, atol=2e-6)
    ((rgb * torch.from_numpy(for_rgb)).sum() + ((1 - alpha) * torch.from_numpy(for_light)).sum()).backward()
    theirs = np.concatenate([tensor.grad.numpy().reshape(len(p), -1) for tensor in tensors], axis=1)
    for name, columns in {**GROUPS, "sh": slice(11, None)}.items():
        largest = np.abs(theirs[:, columns]).max()
        np.testing.assert_allclose(ours[:, columns], theirs[:, columns], rtol=0, atol=1e-5 * largest, err_msg=name)
    return ours


def test_gradients_match_finite_differences() -> None:
    """In float64, for every parameter of a few Gaussians."""
    parameters, target = random_parameters(3, 6, 2, np.float64), side_view(12, 10)
    weights = np.random.default_rng(1).normal(size=(10, 12, 3))

    def loss() -> float:
        return float((GradientRasterizer(parameters).forward(target).rgb.astype(np.float64) * weights).sum())

    rasterizer = GradientRasterizer(parameters)
    done = rasterizer.forward(target)
    gradients = rasterizer.parameter_gradients(done, rasterizer.backward(done, weights))
    arrays = (parameters.means, parameters.quats, parameters.log_scales, parameters.logits, parameters.sh)
    numeric, step = [], 1e-5
    for array in arrays:
        flat = array.reshape(len(parameters), -1)
        for column in range(flat.shape[1]):
            differences = []
            for row in range(len(parameters)):
                kept = flat[row, column]
                flat[row, column] = kept + step
                above = loss()
                flat[row, column] = kept - step
                differences.append((above - loss()) / (2 * step))
                flat[row, column] = kept
            numeric.append(differences)
    expected = np.array(numeric).T
    np.testing.assert_allclose(gradients, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_the_gradient_of_the_pose_matches_finite_differences() -> None:
    """In float64: moved and turned worlds are rendered by moved and turned cameras."""
    parameters, target = random_parameters(4, 12, 2, np.float64), side_view(12, 10)
    weights = np.random.default_rng(2).normal(size=(10, 12, 3))
    rasterizer = GradientRasterizer(parameters)

    def loss(motion: np.ndarray) -> float:
        moved = replace(target, viewmat=move_world(target.viewmat, motion))
        return float((rasterizer.forward(moved).rgb.astype(np.float64) * weights).sum())

    done = rasterizer.forward(target)
    gradient = rasterizer.pose_gradient(done, rasterizer.backward(done, weights))
    step = 1e-5 * np.eye(6)
    expected = np.array([(loss(row) - loss(-row)) / 2e-5 for row in step])
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_the_gradient_of_the_loss_matches_finite_differences(ssim_weight: float) -> None:
    rng = np.random.default_rng(0)
    rendered, image = rng.uniform(size=(2, 24, 20, 3))
    weights = (rng.uniform(size=(24, 20, 1)) > 0.2).astype(np.float64)
    gradient = photometric_loss(rendered, image, weights, ssim_weight).gradient
    for row, column, channel in ((0, 0, 0), (11, 9, 1), (23, 19, 2), (5, 17, 1)):
        values = []
        for sign in (1, -1):
            moved = rendered.copy()
            moved[row, column, channel] += sign * 1e-6
            values.append(photometric_loss(moved, image, weights, ssim_weight).value)
        assert gradient[row, column, channel] == pytest.approx((values[0] - values[1]) / 2e-6, abs=1e-8)


def test_gradients_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    target, found = side_view(), []
    monkeypatch.setattr("idesplat.runtime.refinement.rasterizer.BLOCK", 64)
    for threads in (1, 5):
        monkeypatch.setattr("idesplat.runtime.refinement.rasterizer.MOST_THREADS", threads)
        monkeypatch.setattr("os.cpu_count", lambda: 8)
        rasterizer = GradientRasterizer(random_parameters(4, 500, 1))
        done = rasterizer.forward(target)
        found.append(rasterizer.parameter_gradients(done, rasterizer.backward(done, np.ones_like(done.rgb))))
    np.testing.assert_array_equal(*found)
