"""Plane-sweep cost volume: the correlation of each pixel with its neighbours' features at each candidate depth.

With pi_ij(x, w_m) the projection into neighbour j of view i's pixel x at candidate inverse depth w_m,

    C(x, m) = mean over j of <F_i(x), F_j(pi_ij(x, w_m))> / sqrt(channels)

where F_j is sampled bilinearly (DepthSplat's multi-view branch, after UniMatch). It is computed in one of two ways.
PyTorch samples features with grid_sample, then takes inner products. In ONNX that operator, GridSample, is slow on CPUs
and missing in some runtimes. Interpolation and inner product commute, so a graph scores the four whole pixels around pi
and interpolates the scores.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..common.bilinear import bordered, corners_around, interpolate
from ..common.gather_attention import GatherAttention
from ..common.geometry import Cameras, denormalize_intrinsics, first_rows, sampling_points
from ..common.layers import repeat_views, static_dim, to_tokens

CORNERS = 4  # pixels around a point


def cost_volume(
    features: Tensor, candidates: Tensor, cameras: Cameras, neighbours: Tensor, gather_attention: GatherAttention
) -> Tensor:
    """Correlation of features [views, channels, h, w] with those of the neighbours, warped: [views, candidates, h, w].

    candidates: inverse depths [views, candidates, h, w]. neighbours: [views, n]; their costs are averaged.
    A point is projected into a neighbour with the neighbour's intrinsics. The release takes those of the reference
    view, which were the same throughout its training.
    """
    views, _, height, width = features.shape
    channels, count = static_dim(features.shape[1]), static_dim(candidates.shape[1])
    intrinsics = denormalize_intrinsics(cameras.intrinsics, width, height)
    x, y = sampling_points(candidates, intrinsics, cameras.extrinsics, neighbours)
    if torch.onnx.is_in_onnx_export():
        scores = by_gathering(features, neighbours, x, y, gather_attention)
    else:
        scores = by_sampling(features, neighbours, x, y)
    scores = scores * channels**-0.5
    return scores.reshape(views, -1, count, height * width).mean(1).reshape(-1, count, height, width)


def by_sampling(features: Tensor, neighbours: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Correlation with features sampled at x and y: [pairs, candidates, h * w], the shape of x and y."""
    height, width = features.shape[2:]
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    warped = F.grid_sample(features[neighbours].flatten(0, 1), grid, align_corners=True)
    own = repeat_views(features.flatten(2), neighbours.shape[1])[:, :, None]  # [pairs, channels, 1, h * w]
    return (warped * own).sum(1)


def by_gathering(
    features: Tensor, neighbours: Tensor, x: Tensor, y: Tensor, gather_attention: GatherAttention
) -> Tensor:
    """The same from the correlations with the four pixels around x and y."""
    own = repeat_views(to_tokens(features), neighbours.shape[1])  # [pairs, h * w, channels]
    table = to_tokens(bordered(features))  # [views, bordered pixels, channels]
    first = first_rows(neighbours, features.shape[0], table.shape[1])[:, None, None]
    corners, across, down = corners_around(x, y, *features.shape[2:])
    rows = torch.cat([first + corner for corner in corners], dim=1)  # [pairs, 4 * candidates, h * w]
    scores = gather_attention.gathered_dot(own, table.flatten(0, 1), rows)
    return interpolate(scores.split(static_dim(x.shape[1]), dim=1), across, down)
