"""The perceptual distance on ImageNet features: by hand, and on images."""

import math

import pytest
import torch
from idesplat.tools.perceptual import EfficientNetDistance, squared_distance


def test_distance_of_features_by_hand() -> None:
    """Two pixels: features at 60 degrees at the first, parallel features of different length at the second."""
    first = torch.tensor([[[[2.0, 3.0]], [[0.0, 4.0]]]])
    angle = math.radians(60)
    second = torch.tensor([[[[5 * math.cos(angle), 0.3]], [[5 * math.sin(angle), 0.4]]]])
    expected = (2 - 2 * math.cos(angle)) / 2  # |a - b|^2 of unit vectors, and nothing, over two pixels
    assert float(squared_distance(first, second)) == pytest.approx(expected, rel=1e-5)


def test_blur_is_farther_than_a_small_gain() -> None:
    distance = EfficientNetDistance()
    truth = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    blurred = torch.nn.functional.avg_pool2d(truth, 5, stride=1, padding=2, count_include_pad=False)
    brighter = (truth * 1.05).requires_grad_()
    assert float(distance(truth, truth)) == pytest.approx(0, abs=1e-9)
    found = distance(brighter, truth)
    assert 0 < float(found.detach()) < 0.2 * float(distance(blurred, truth))
    found.backward()
    assert brighter.grad is not None and brighter.grad.abs().sum() > 0
    assert not any(p.requires_grad for p in distance.network.parameters())
