"""EfficientNet features: the published network's numbers, and a network that has them in place of a ViT."""

from pathlib import Path

import numpy as np
import pytest
import torch
from idesplat.model.idesplat.config import IDESplatConfig
from idesplat.model.idesplat.efficientnet import CHANNELS, STRIDES, EfficientNetLite0
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS
from idesplat.runtime.errors import InputError
from idesplat.tools import imagenet
from idesplat.tools.imagenet import load_imagenet_weights
from idesplat.tools.training.initialization import new_model
from idesplat.tools.training.state import PHOTO_NETWORK_PREFIX, WEIGHT_DECAY, TrainingState

LITE = PRESETS["idesplat-lite"]
# What the package efficientnet-lite-pytorch 0.1.0 computes with the published weights for the image below, before any
# folding: mean of the absolute values of a map, and its first four channels at row 3, column 5.
REFERENCE = (
    (5.813064, (2.79826, -3.86941, -0.38369, 12.95579)),
    (9.032556, (-6.26762, 16.42156, -4.92857, 3.27467)),
    (7.545796, (-2.4628, 9.89131, 11.28619, -1.78157)),
    (4.825793, (4.81784, 3.61155, 4.67743, 11.78407)),
)


def ramps(side: int) -> torch.Tensor:
    y, x = np.mgrid[:side, :side] / side
    return torch.from_numpy(np.stack([x, y, (x * y * 40) % 1]).astype(np.float32))[None]


def test_maps_are_those_of_the_published_network() -> None:
    network = EfficientNetLite0()
    load_imagenet_weights(network)
    with torch.no_grad():
        maps = network(ramps(224))
    for found, stride, channels, (mean, values) in zip(maps, STRIDES, CHANNELS, REFERENCE, strict=True):
        assert found.shape == (1, channels, 224 // stride, 224 // stride)
        assert float(found.abs().mean()) == pytest.approx(mean, rel=1e-4)
        assert found[0, :4, 3, 5].tolist() == pytest.approx(values, abs=2e-3)


def test_lite_preset_keeps_to_its_size() -> None:
    assert isinstance(LITE, IDESplatConfig)
    with torch.device("meta"):
        model = IDESplat(LITE)
    counts = {name: parameter.numel() for name, parameter in model.named_parameters()}
    frozen = sum(count for name, count in counts.items() if name.startswith(PHOTO_NETWORK_PREFIX))
    assert frozen == 692_688
    assert sum(counts.values()) - frozen <= 4_000_000
    assert 4 * sum(counts.values()) <= 20e6  # bytes as float32
    assert LITE.size_multiple == 32


def test_new_network_has_the_published_weights_and_keeps_them() -> None:
    state = TrainingState(LITE, seed=0, lr=1e-3, vit_lr=1e-3)
    network = EfficientNetLite0()
    load_imagenet_weights(network)
    frozen = {name: value for name, value in state.model.named_parameters() if name.startswith(PHOTO_NETWORK_PREFIX)}
    assert all(torch.equal(frozen[PHOTO_NETWORK_PREFIX + name], value) for name, value in network.named_parameters())
    assert not any(value.requires_grad for value in frozen.values())
    trained = {id(p) for group in state.optimizer.param_groups for p in group["params"]}
    assert len(trained) == sum(1 for p in state.model.parameters() if p.requires_grad)
    assert not trained & {id(value) for value in frozen.values()}


def test_a_learning_rate_of_their_own_trains_the_published_weights() -> None:
    state = TrainingState(LITE, seed=0, lr=0.0, vit_lr=0.0, photo_lr=1e-4)
    stem = state.model.get_parameter(PHOTO_NETWORK_PREFIX + "stem.weight")
    before = stem.detach().clone()
    stem.grad = torch.ones_like(stem)
    state.update(0.5)
    # Weights decay by the learning rate's share, and Adam's first step is the learning rate.
    expected = before * (1 - 0.5e-4 * WEIGHT_DECAY) - 0.5e-4
    torch.testing.assert_close(stem.detach(), expected, rtol=1e-6, atol=1e-6)


def test_missing_weights_are_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(imagenet, "WEIGHTS_PACKAGE", "no_such_package_of_weights")
    with pytest.raises(InputError, match="install the package no_such_package_of_weights"):
        new_model(LITE, seed=0)
