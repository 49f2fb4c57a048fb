"""Comparison of each pixel with its projections in the neighbouring views, as an input of the Gaussian head.

With w the pixel's inverse depth as seen from a neighbour and w' what the neighbour predicts there, the agreement is
1 / (1 + ((w' / w - 1) / TOLERANCE)^2), zero outside the neighbour's image.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..common.bilinear import bordered, corners_around, interpolate
from ..common.geometry import Cameras, denormalize_intrinsics, first_rows, project_points
from ..common.layers import repeat_views, to_tokens

# Relative difference of inverse depth at which the agreement is one half.
TOLERANCE = 0.02
# Relative differences of inverse depth are clipped to this.
LARGEST_DIFFERENCE = 0.5
# Colour difference weighted by agreement, unweighted, difference of inverse depth, agreement, visibility.
CHANNELS = 3 + 3 + 1 + 1 + 1


def cross_view_features(images: Tensor, inverse_depth: Tensor, cameras: Cameras, neighbours: Tensor) -> Tensor:
    """Features of the comparison, averaged over the neighbours: [views, CHANNELS, H, W].

    images: [views, 3, H, W] in [0, 1]. inverse_depth: [views, 1, H, W]. neighbours: [views, n]. Positions of the
    projections have no gradient.
    """
    views, _, height, width = images.shape
    x, y, projected = _project(inverse_depth, cameras, neighbours)  # [pairs, 1, H * W]
    inside = torch.ones_like(inverse_depth)
    shown = _sample(torch.cat([images, inverse_depth, inside], dim=1), neighbours, x, y)  # [pairs, 5, H * W]
    colours, surface, inside = shown.split((3, 1, 1), dim=1)
    own = repeat_views(images.flatten(2), neighbours.shape[1])
    colour = colours - inside * own
    difference = (surface / projected.clamp(min=torch.finfo(projected.dtype).tiny) - inside).clamp(
        -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE
    )
    agreement = inside / (1 + (difference / TOLERANCE).square())
    pairs = torch.cat([agreement * colour, colour, difference, agreement, inside], dim=1)
    total = pairs.reshape(views, -1, CHANNELS, height * width).sum(1)  # over the neighbours
    agreeing, rest = total.split((3, CHANNELS - 3), dim=1)
    # Mean colour of the views that agree, less the view's own; the view itself counts as one of them.
    consensus = agreeing / (1 + rest[:, 4:5])
    return torch.cat([consensus, rest / neighbours.shape[1]], dim=1).reshape(views, CHANNELS, height, width)


@torch.no_grad()
def _project(inverse_depth: Tensor, cameras: Cameras, neighbours: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projections in each neighbour, x and y, and the inverse depth there, each [views * n, 1, H * W].

    Positions outside the image or behind the camera are clamped to the border of zeros.
    """
    height, width = inverse_depth.shape[2:]
    pixels = denormalize_intrinsics(cameras.intrinsics, width, height)
    x, y, projected, front = project_points(inverse_depth, pixels, cameras.extrinsics, neighbours)
    return torch.where(front, x, -1.0).clamp(-1, width), torch.where(front, y, -1.0).clamp(-1, height), projected


def _sample(maps: Tensor, neighbours: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Maps [views, channels, H, W] of the neighbours, bilinearly at x and y [views * n, 1, H * W], zero outside."""
    height, width = maps.shape[2:]
    table = to_tokens(bordered(maps))  # [views, bordered pixels, channels]
    first = first_rows(neighbours, maps.shape[0], table.shape[1])[:, None]
    corners, across, down = corners_around(x[:, 0], y[:, 0], height, width)
    rows = table.flatten(0, 1)
    around = [F.embedding(first + corner, rows) for corner in corners]  # each [pairs, H * W, channels]
    return interpolate(around, across[..., None], down[..., None]).transpose(1, 2)
