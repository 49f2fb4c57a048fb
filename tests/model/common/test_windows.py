"""Shifted windows: attention within regions is what the releases compute with a mask over whole windows."""

import pytest
import torch
from idesplat.model.common.layers import attention
from idesplat.model.common.windows import Regions, region_mask

CHANNELS = 5


@pytest.mark.parametrize("chunks", [1, 2])
@pytest.mark.parametrize(("splits", "rows", "columns"), [(2, 4, 6), (3, 2, 4), (4, 2, 2)])
def test_attention_within_regions_is_masked_attention(splits, rows, columns, chunks):
    """With keys of several views, too, over which the releases repeat the mask."""
    torch.manual_seed(0)
    tokens = rows * columns
    q = torch.randn(2, splits**2, tokens, CHANNELS, dtype=torch.float64)
    k, v = torch.randn(2, 2, splits**2, chunks * tokens, CHANNELS, dtype=torch.float64)
    mask = region_mask(splits * rows, splits * columns, rows, columns, q).repeat(1, 1, chunks)
    regions = Regions(splits, rows, columns)
    found = regions.join([attention(*group) for group in zip(*(regions.split(x) for x in (q, k, v)), strict=True)])
    torch.testing.assert_close(found, attention(q, k, v, mask), rtol=1e-12, atol=1e-12)
    assert (found - attention(q, k, v)).abs().max() > 0.1  # the mask matters


def test_regions_hold_every_token_once_and_nine_sixteenths_of_the_scores():
    regions = Regions(2, 4, 6)
    windows = torch.arange(2 * 4 * 24 * 3.0).reshape(2, 4, 24, 3)
    groups = regions.split(windows)
    assert torch.equal(regions.join(groups), windows)
    scores = sum(group.shape[0] * group.shape[1] ** 2 for group in groups)
    assert scores == 2 * 4 * 24**2 * 9 / 16
