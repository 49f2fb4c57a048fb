"""Convolutions of few channels in channels-last order."""

import torch
from idesplat.tools.training.convolutions import MOST_CHANNELS, use_channels_last
from torch import Tensor, nn


def _network() -> nn.Sequential:
    torch.manual_seed(0)
    few = nn.Conv2d(MOST_CHANNELS, 16, 3, padding=1)
    return nn.Sequential(few, nn.GroupNorm(4, 16), nn.SiLU(), nn.Conv2d(16, 8, 3, padding=1)).double()


def test_results_and_gradients_are_those_of_image_order() -> None:
    images = torch.randn(2, MOST_CHANNELS, 12, 10, dtype=torch.float64)
    plain, other = _network(), _network()
    use_channels_last(other)
    gradients = []
    for network in (plain, other):
        inputs = images.clone().requires_grad_()
        output = network(inputs)
        assert output.is_contiguous()
        output.square().sum().backward()
        gradients.append([inputs.grad, *(parameter.grad for parameter in network.parameters())])
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-12)


def test_few_channels_alone_are_in_channels_last_order() -> None:
    network = _network()
    use_channels_last(network)
    found: list[Tensor] = []

    def record(_: nn.Module, inputs: tuple[Tensor]) -> None:
        found.append(inputs[0])

    for layer in (network[0], network[3]):
        layer.register_forward_pre_hook(record)
    network(torch.randn(2, MOST_CHANNELS, 12, 10, dtype=torch.float64))
    in_channels_last = [image.is_contiguous(memory_format=torch.channels_last) for image in found]
    assert in_channels_last == [True, False]
