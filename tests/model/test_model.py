"""The network by itself: any size of configuration, the same in training and evaluation, differentiable."""

import pytest
import torch
from conftest import SMALL, small_network
from idesplat.export.example_inputs import example_inputs
from idesplat.model.common import geometry
from idesplat.model.common.gaussian_adapter import GaussianAdapter
from idesplat.model.common.geometry import Cameras
from idesplat.model.common.quaternions import matrices_to_quaternions
from idesplat.model.idesplat.config import IDESplatConfig
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS


def count_parameters(model):
    return sum(parameter.numel() for parameter in model.parameters())


def test_small_network_has_a_tenth_of_the_parameters():
    with torch.device("meta"):
        assert count_parameters(IDESplat(SMALL)) < count_parameters(IDESplat(PRESETS["idesplat-re10k"])) / 10


@pytest.mark.parametrize(("views", "height", "width"), ((2, 64, 96), (3, 96, 64), (5, 64, 64)))
def test_any_number_of_views_and_size(views, height, width):
    inputs = example_inputs(views, height, width, near=0.5, far=100.0)
    with torch.no_grad():
        predicted = small_network()(*inputs.values())
    assert predicted.depth.shape == (views, height, width)
    assert ((predicted.depth >= 0.5 * (1 - 1e-5)) & (predicted.depth <= 100 * (1 + 1e-5))).all()
    pixels = views * height * width
    shapes = [tuple(x.shape) for x in predicted.gaussians]
    assert shapes == [(pixels, 3), (pixels, 3), (pixels, 4), (pixels,), (pixels, 9, 3)]
    assert all(x.isfinite().all() for x in predicted.gaussians)
    torch.testing.assert_close(predicted.gaussians.quats.norm(dim=-1), torch.ones(pixels))


def test_training_mode_computes_the_same():
    inputs = example_inputs(2, 64, 64, near=0.5, far=100.0)
    model = small_network()
    with torch.no_grad():
        evaluated, trained = model.eval()(*inputs.values()), model.train()(*inputs.values())
    assert torch.equal(evaluated.depth, trained.depth)
    assert torch.equal(evaluated.raw, trained.raw)


def test_gradients_reach_images_and_every_weight():
    inputs = example_inputs(2, 64, 64, near=0.5, far=100.0)
    inputs["images"].requires_grad_()
    model = small_network()
    predicted = model(*inputs.values())
    loss = (1 / predicted.depth).sum() + sum(x.square().mean() for x in predicted.gaussians)
    loss.backward()
    assert inputs["images"].grad.abs().sum() > 0
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert without == []


def test_rigid_inverse():
    extrinsics = example_inputs(3, 32, 32, 0.5, 100.0)["extrinsics"]
    torch.testing.assert_close(geometry.invert_rigid(extrinsics), torch.linalg.inv(extrinsics))


def test_intrinsics_inverse():
    intrinsics = torch.tensor([[[300.0, 0, 130], [0, 280, 125], [0, 0, 1]]])
    torch.testing.assert_close(geometry.invert_intrinsics(intrinsics), torch.linalg.inv(intrinsics))


def test_neighbours_are_all_others_in_order_up_to_three_views_and_the_nearest_beyond():
    extrinsics = torch.eye(4).repeat(5, 1, 1)
    extrinsics[:, 0, 3] = torch.tensor([0.0, 10, 1, 3, 11])
    assert geometry.nearest_views(extrinsics[:2], 2).tolist() == [[1], [0]]
    assert geometry.nearest_views(extrinsics[:3], 2).tolist() == [[1, 2], [0, 2], [0, 1]]
    assert geometry.nearest_views(extrinsics, 2).tolist() == [[2, 3], [4, 3], [0, 3], [2, 0], [1, 3]]


def test_quaternions_give_their_matrices_back():
    torch.manual_seed(1)
    rotations = torch.linalg.qr(torch.randn(64, 3, 3))[0]
    rotations = rotations * torch.linalg.det(rotations)[:, None, None]
    flips = torch.stack(
        [torch.diag(torch.tensor(d)) for d in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    )
    rotations = torch.cat([rotations, flips])
    w, x, y, z = matrices_to_quaternions(rotations).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    torch.testing.assert_close(torch.stack([torch.stack(r, -1) for r in rows], -2), rotations, atol=1e-5, rtol=0)


def test_warp_indices_see_a_plane_where_it_is():
    """A plane at depth 2 before two cameras 0.5 apart: the right candidate moves a pixel by f * 0.5 / 2."""
    intrinsics = torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]).repeat(2, 1, 1)
    extrinsics = torch.eye(4).repeat(2, 1, 1)
    extrinsics[1, 0, 3] = 0.5
    candidates = torch.tensor([0.5, 1e-6]).view(1, 2, 1, 1).expand(2, -1, 16, 16)
    rows = geometry.warp_indices(candidates, intrinsics, extrinsics, torch.tensor([[1], [0]])).view(2, 2, 16, 16)
    pixel, outside = torch.arange(256).view(16, 16), 2 * 256
    assert (rows[0, 0, :, 4:] == 256 + pixel[:, :-4]).all()  # view 0 looks into view 1, shifted by 4 pixels
    assert (rows[0, 0, :, :4] == outside).all()
    assert (rows[1, 0, :, :-4] == pixel[:, 4:]).all()
    assert (rows[0, 1, :, 1:] == 256 + pixel[:, 1:]).all()  # far away nothing moves by as much as half a pixel


def test_scales_in_pixels_follow_depth_and_focal_length() -> None:
    """Where a network predicts scales in pixels, a splat covers as many of them at any depth and focal length."""
    plain, in_pixels = (GaussianAdapter(IDESplatConfig(sh_degree=1, scale_in_pixels=flag)) for flag in (False, True))
    torch.manual_seed(0)
    raw, images = torch.randn(2, 22, 4, 6), torch.rand(2, 3, 4, 6)
    depth = torch.rand(2, 4, 6) + 1
    intrinsics = torch.tensor([[0.8, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]]).expand(2, 3, 3)
    cameras = Cameras(torch.eye(4).expand(2, 4, 4), intrinsics, torch.ones(2), torch.full((2,), 9.0))
    expected = plain(raw, depth, images, cameras)
    found = in_pixels(raw, depth, images, cameras)
    pixel = depth.reshape(-1, 1) / (0.8 * 6)
    torch.testing.assert_close(found.scales, expected.scales * pixel)
    for name in ("means", "quats", "opacities", "sh"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
