"""What neighbouring views show at a pixel's place: scenes whose answer is known by hand."""

import pytest
import torch
from idesplat.model.common.geometry import Cameras, denormalize_intrinsics, nearest_views
from idesplat.model.idesplat.cross_view import CHANNELS, TOLERANCE, cross_view_features

SIZE, DEPTH, FOCAL = 16, 4.0, 1.0  # pixels, scene units, image widths
SHIFT = 2  # pixels that a surface at DEPTH moves from one view to the next


def plane(brighter: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, Cameras]:
    """Two cameras side by side before a plane; the second image is the first, moved, and `brighter`."""
    generator = torch.Generator().manual_seed(3)
    wide = torch.rand(3, SIZE, SIZE + SHIFT, generator=generator) * 0.5
    images = torch.stack([wide[:, :, :SIZE], wide[:, :, SHIFT:] + brighter])
    extrinsics = torch.eye(4).repeat(2, 1, 1)
    extrinsics[1, 0, 3] = SHIFT * DEPTH / (FOCAL * SIZE)
    intrinsics = torch.tensor([[FOCAL, 0, 0.5], [0, FOCAL, 0.5], [0, 0, 1]]).repeat(2, 1, 1)
    depth_range = torch.ones(2), torch.full((2,), 10.0)
    return images, torch.full((2, 1, SIZE, SIZE), 1 / DEPTH), Cameras(extrinsics, intrinsics, *depth_range)


def compared(images: torch.Tensor, inverse_depth: torch.Tensor, cameras: Cameras) -> tuple[torch.Tensor, ...]:
    found = cross_view_features(images, inverse_depth, cameras, nearest_views(cameras.extrinsics, 2))
    assert found.shape == (2, CHANNELS, SIZE, SIZE)
    return found.split((3, 3, 1, 1, 1), dim=1)


def test_true_depth_meets_the_same_colour() -> None:
    consensus, colour, difference, agreement, inside = compared(*plane(brighter=0.1))
    seen = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    seen[:, SHIFT:] = True  # the first view's left columns lie outside of the second
    assert torch.equal(inside[0, 0] > 0.999, seen)
    assert torch.equal(inside[1, 0] > 0.999, seen.flip(1))
    assert difference[0, 0][seen].abs().max() < 1e-4 and agreement[0, 0][seen].min() > 0.999
    assert torch.allclose(colour[0][:, seen], torch.tensor(0.1), atol=1e-4)
    assert torch.allclose(consensus[0][:, seen], torch.tensor(0.05), atol=1e-4)  # half way between both
    assert torch.allclose(consensus[1][:, seen.flip(1)], torch.tensor(-0.05), atol=1e-4)
    assert not agreement[0, 0][~seen].any() and not colour[0][:, ~seen].any()


@pytest.mark.parametrize("share", [TOLERANCE, -TOLERANCE, 0.1])
def test_other_depth_of_the_neighbour_is_told(share: float) -> None:
    images, inverse_depth, cameras = plane()
    inverse_depth[1] *= 1 + share
    _, _, difference, agreement, _ = compared(images, inverse_depth, cameras)
    middle = difference[0, 0, 4:12, 6:10]
    assert torch.allclose(middle, torch.tensor(share), atol=1e-4)
    expected = 1 / (1 + (share / TOLERANCE) ** 2)
    assert torch.allclose(agreement[0, 0, 4:12, 6:10], torch.tensor(expected), atol=1e-3)


def test_pixels_are_compared_where_the_warp_indices_point() -> None:
    """The depth decides the place: at half the inverse depth a pixel is compared with one half as far away."""
    images, inverse_depth, cameras = plane()
    _, colour, _, _, _ = compared(images, inverse_depth / 2, cameras)
    pixels = denormalize_intrinsics(cameras.intrinsics, SIZE, SIZE)
    assert pixels[0, 0, 0] == FOCAL * SIZE
    expected = images[1][:, :, 8 - SHIFT // 2] - images[0][:, :, 8]
    assert torch.allclose(colour[0][:, :, 8], expected, atol=1e-4)
