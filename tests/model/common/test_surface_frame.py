"""Gaussians in the frame of the surface that a depth map shows."""

import io

import numpy as np
import onnxruntime as ort
import pytest
import torch
from idesplat.model.common.gaussian_adapter import GaussianAdapter
from idesplat.model.common.geometry import Cameras, unproject
from idesplat.model.common.quaternions import pairwise_product, quaternions_to_matrices
from idesplat.model.common.surface_frame import MAX_SLOPE, surface_frames
from idesplat.model.idesplat.config import IDESplatConfig

HEIGHT, WIDTH = 24, 32
K = torch.tensor([[0.9, 0, 0.5], [0, 1.1, 0.52], [0, 0, 1]])
CAMERAS = Cameras(torch.eye(4)[None], K[None], torch.ones(1), torch.full((1,), 9.0))
CENTRES = torch.full((1, HEIGHT * WIDTH, 2), 0.5)


def plane(normal: torch.Tensor, distance: float) -> torch.Tensor:
    """The inverse depth of the plane normal . P = distance, [1, HEIGHT, WIDTH]."""
    directions = unproject(torch.ones(1, HEIGHT, WIDTH), CENTRES, CAMERAS)
    return (directions @ normal / distance).view(1, HEIGHT, WIDTH)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.3, 0.8), (-0.4, 0.1, 0.7)])
def test_frames_of_a_plane_have_its_normal_and_sizes_are_steps_along_it(normal: tuple[float, ...]) -> None:
    normal = torch.nn.functional.normalize(torch.tensor(normal), dim=0)
    inverse_depth = plane(normal, 4.0)
    quats, sizes = surface_frames(inverse_depth, CAMERAS)
    torch.testing.assert_close(quaternions_to_matrices(quats)[0, :, :, 2], normal.expand(HEIGHT * WIDTH, 3))
    # A step of a fiftieth of a pixel from the pixel's centre to the ray beside it, on the plane.
    step = 0.02
    start = unproject(1 / inverse_depth, CENTRES, CAMERAS)
    for axis, pixel in ((0, 1 / (0.9 * WIDTH)), (1, 1 / (1.1 * HEIGHT))):
        aside = CENTRES.clone()
        aside[..., axis] += step
        rays = unproject(torch.ones(1, HEIGHT, WIDTH), aside, CAMERAS)
        moved = rays * (4.0 / (rays @ normal))[..., None] - start
        expected = moved.norm(dim=-1) * inverse_depth.flatten(1) / (step * pixel)
        torch.testing.assert_close(sizes[..., axis], expected, rtol=2e-2, atol=0)
    assert (sizes[..., 2] == 1).all()


def test_an_edge_of_depth_has_the_frames_of_both_sides() -> None:
    """Two planes that face the camera: no pixel is on the slope between them."""
    inverse_depth = torch.cat([torch.full((1, HEIGHT, 10), 0.5), torch.full((1, HEIGHT, WIDTH - 10), 0.25)], dim=2)
    quats, sizes = surface_frames(inverse_depth, CAMERAS)
    torch.testing.assert_close(quats, torch.tensor([1.0, 0, 0, 0]).expand_as(quats))
    torch.testing.assert_close(sizes, torch.ones_like(sizes))


def test_steep_surfaces_count_as_less_steep() -> None:
    """The normal is [a, 0, 1 - x a] for a slope a along x, so that a = nx / (nz + x nx)."""
    inverse_depth = 1 + torch.linspace(-0.4, 0.4, WIDTH).expand(1, HEIGHT, WIDTH) * 10
    inverse_depth = inverse_depth.clamp(min=0.1)
    quats, _ = surface_frames(inverse_depth, CAMERAS)
    normals = quaternions_to_matrices(quats)[0, :, :, 2].view(HEIGHT, WIDTH, 3)
    x = (WIDTH // 2 + 0.5) / WIDTH / 0.9 - 0.5 / 0.9
    nx, _, nz = normals[HEIGHT // 2, WIDTH // 2]
    slope = nx / (nz + x * nx)
    assert float(slope) == pytest.approx(MAX_SLOPE, rel=0.02)


def test_products_of_pairs_are_those_of_matrices() -> None:
    first, second = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    expected = quaternions_to_matrices(first) @ quaternions_to_matrices(second)
    torch.testing.assert_close(quaternions_to_matrices(pairwise_product(first, second)), expected)


class Adapter(torch.nn.Module):
    """The adapter with cameras as tensors, for export."""

    def __init__(self) -> None:
        super().__init__()
        self.adapter = GaussianAdapter(IDESplatConfig(sh_degree=1, scale_in_pixels=True, surface_frame=True))

    def forward(self, raw: torch.Tensor, depth: torch.Tensor, images: torch.Tensor, extrinsics: torch.Tensor):
        return tuple(self.adapter(raw, depth, images, Cameras(extrinsics, K.repeat(2, 1, 1), depth, depth)))


@pytest.mark.filterwarnings("ignore")  # the exporter's deprecation, and tracing warnings about constants
def test_onnx_runtime_gives_the_same_gaussians() -> None:
    generator = torch.Generator().manual_seed(0)
    raw, images = torch.randn(2, 22, 8, 12, generator=generator), torch.rand(2, 3, 8, 12, generator=generator)
    depth = torch.rand(2, 8, 12, generator=generator) + 1
    inputs = {"raw": raw, "depth": depth, "images": images, "extrinsics": torch.eye(4).repeat(2, 1, 1)}
    file = io.BytesIO()
    torch.onnx.export(Adapter(), tuple(inputs.values()), file, input_names=list(inputs), opset_version=20, dynamo=False)
    found = ort.InferenceSession(file.getvalue()).run(None, {name: value.numpy() for name, value in inputs.items()})
    for ours, theirs in zip(found, Adapter()(*inputs.values()), strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-5)
