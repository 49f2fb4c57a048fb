"""How well each pixel matches its neighbours at each candidate depth, by bilinear warping (plane sweep).

Two forms of the same sums. PyTorch has an operator that samples features, which are then scored. In ONNX it is called
GridSample, slow on CPUs and missing elsewhere. Interpolation and inner product commute, so a graph scores whole pixels
first and interpolates between four scores.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..common.bilinear import bordered, corners_around, interpolate
from ..common.gather_attention import GatherAttention
from ..common.geometry import Cameras, denormalize_intrinsics, sampling_points
from ..common.layers import repeat_views, static_dim, to_tokens

CORNERS = 4  # pixels around a point


def cost_volume(
    features: Tensor, candidates: Tensor, cameras: Cameras, neighbours: Tensor, gather_attention: GatherAttention
) -> Tensor:
    """Correlation of features [views, channels, h, w] with those of the neighbours, warped: [views, candidates, h, w].

    candidates: inverse depths [views, candidates, h, w]. neighbours: [views, n]; their costs are averaged.
    Each view projects with its own intrinsics; the release projects into a neighbour with those of the view that looks,
    which are the same in all that it was trained on.
    """
    views, _, height, width = features.shape
    channels, count = static_dim(features.shape[1]), static_dim(candidates.shape[1])
    intrinsics = denormalize_intrinsics(cameras.intrinsics, height, width)
    x, y = sampling_points(candidates, intrinsics, cameras.extrinsics, neighbours)
    if torch.onnx.is_in_onnx_export():
        scores = by_gathering(features, neighbours, x, y, gather_attention)
    else:
        scores = by_sampling(features, neighbours, x, y)
    scores = scores * channels**-0.5
    return scores.reshape(views, -1, count, height * width).mean(1).reshape(-1, count, height, width)


def by_sampling(features: Tensor, neighbours: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Scores of every pixel with its neighbours' features at x and y, [pairs, candidates, h * w] like x and y."""
    height, width = features.shape[2:]
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    warped = F.grid_sample(features[neighbours].flatten(0, 1), grid, align_corners=True)
    own = repeat_views(features.flatten(2), neighbours.shape[1])[:, :, None]  # [pairs, channels, 1, h * w]
    return (warped * own).sum(1)


def by_gathering(
    features: Tensor, neighbours: Tensor, x: Tensor, y: Tensor, gather_attention: GatherAttention
) -> Tensor:
    """The same by gathering the features of the four pixels around each candidate."""
    own = repeat_views(to_tokens(features), neighbours.shape[1])  # [pairs, h * w, channels]
    table = to_tokens(bordered(features))  # [views, bordered pixels, channels]
    first = (neighbours.flatten() * table.shape[1]).to(torch.int32)[:, None, None]
    corners, across, down = corners_around(x, y, *features.shape[2:])
    rows = torch.cat([first + corner for corner in corners], dim=1)  # [pairs, 4 * candidates, h * w]
    scores = gather_attention.gathered_dot(own, table.flatten(0, 1), rows)
    return interpolate(scores.split(static_dim(x.shape[1]), dim=1), across, down)
