"""The compiled sparse products against the network's own: the same values and gradients."""

import torch
from idesplat.model import epipolar_attention as gathered
from idesplat.tools import sparse_products as compiled

PAIRS, CANDIDATES, PIXELS, CHANNELS = 4, 11, 30, 6


def test_values_and_gradients_are_the_networks_own() -> None:
    torch.manual_seed(0)
    rows = torch.randint(0, PAIRS * PIXELS + 1, (PAIRS, CANDIDATES, PIXELS))  # the last row is of zeros
    queries, weights = torch.randn(PAIRS, PIXELS, CHANNELS), torch.rand(PAIRS, CANDIDATES, PIXELS)
    table = gathered.pixel_table(torch.randn(PAIRS, PIXELS, CHANNELS))
    for name, left in (("correlate", queries), ("weigh", weights)):
        results = []
        for module in (gathered, compiled):
            inputs = [part.clone().requires_grad_() for part in (left, table)]
            product = getattr(module, name)(*inputs, rows)
            gradients = torch.autograd.grad(product.square().sum(), inputs)
            results.append((product, *gradients))
        for expected, found in zip(*results, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
