"""Layers on maps against PyTorch's own on tokens."""

import torch
import torch.nn.functional as F
from idesplat.model.common.layers import ConvFFN, MapLayerNorm, MapLinear, to_map, to_tokens
from torch import Tensor, nn

CHANNELS, HEIGHT, WIDTH = 6, 4, 5


def random_weights(module: nn.Module) -> nn.Module:
    generator = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        nn.init.normal_(parameter, generator=generator)
    return module


def random_maps() -> Tensor:
    return torch.randn(2, CHANNELS, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) * 3 + 2


def test_normalisation_of_maps_is_layer_norm_of_their_tokens() -> None:
    norm, maps = random_weights(MapLayerNorm(CHANNELS)), random_maps()
    expected = F.layer_norm(to_tokens(maps), (CHANNELS,), norm.weight, norm.bias)
    torch.testing.assert_close(to_tokens(norm(maps)), expected)


def test_linear_layer_of_maps_is_that_of_their_tokens() -> None:
    linear, maps = random_weights(MapLinear(CHANNELS, 9)), random_maps()
    torch.testing.assert_close(to_tokens(linear(maps)), F.linear(to_tokens(maps), linear.weight, linear.bias))


def test_feed_forward_layer_of_maps_is_that_of_their_tokens() -> None:
    ffn, maps = random_weights(ConvFFN(CHANNELS, 2, 3)).double(), random_maps().double()
    hidden = F.gelu(F.linear(to_tokens(maps), ffn.fc1.weight, ffn.fc1.bias))
    depthwise = ffn.depthwise.conv
    local = F.conv2d(to_map(hidden, HEIGHT, WIDTH), depthwise.weight, depthwise.bias, padding=1, groups=2 * CHANNELS)
    expected = F.linear(hidden + to_tokens(F.gelu(local)), ffn.fc2.weight, ffn.fc2.bias)
    torch.testing.assert_close(to_tokens(ffn(maps)), expected)
