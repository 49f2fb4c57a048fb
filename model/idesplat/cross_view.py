"""What the neighbouring views show where a pixel's depth puts it: the Gaussian head's knowledge of agreement."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..common.bilinear import bordered, corners_around, interpolate
from ..common.geometry import Cameras, denormalize_intrinsics, project_points
from ..common.layers import repeat_views, to_tokens

# Inverse depths that differ by this share of theirs agree half-way.
TOLERANCE = 0.02
# Differences of inverse depth, relative to the pixel's own, are clipped to this.
LARGEST_DIFFERENCE = 0.5
# Colour difference of the views that agree, that of all, difference of inverse depth, agreement, and how many see it.
CHANNELS = 3 + 3 + 1 + 1 + 1


def cross_view_features(images: Tensor, inverse_depth: Tensor, cameras: Cameras, neighbours: Tensor) -> Tensor:
    """Compare each pixel with what its neighbours show at its place in space, [views, CHANNELS, H, W].

    images: [views, 3, H, W] in [0, 1]. inverse_depth: [views, 1, H, W]. neighbours: [views, n]; what they show is
    averaged. Nothing here is differentiated with respect to where a pixel falls.
    """
    views, _, height, width = images.shape
    x, y, there = _places(inverse_depth, cameras, neighbours)  # [pairs, 1, H * W]
    inside = torch.ones_like(inverse_depth)
    shown = _sample(torch.cat([images, inverse_depth, inside], dim=1), neighbours, x, y)  # [pairs, 5, H * W]
    colours, surface, inside = shown.split((3, 1, 1), dim=1)
    own = repeat_views(images.flatten(2), neighbours.shape[1])
    colour = colours - inside * own
    difference = (surface / there.clamp(min=torch.finfo(there.dtype).tiny) - inside).clamp(
        -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE
    )
    agreement = inside / (1 + (difference / TOLERANCE).square())
    pairs = torch.cat([agreement * colour, colour, difference, agreement, inside], dim=1)
    total = pairs.reshape(views, -1, CHANNELS, height * width).sum(1)  # over the neighbours
    agreeing, rest = total.split((3, CHANNELS - 3), dim=1)
    # The view itself agrees with itself: the mean colour of all that agree, less its own.
    consensus = agreeing / (1 + rest[:, 4:5])
    return torch.cat([consensus, rest / neighbours.shape[1]], dim=1).reshape(views, CHANNELS, height, width)


@torch.no_grad()
def _places(inverse_depth: Tensor, cameras: Cameras, neighbours: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where pixels fall in each neighbour, x and y, and their inverse depth there, each [views * n, 1, H * W].

    What falls outside or behind the camera is brought to where the border of zeros is.
    """
    height, width = inverse_depth.shape[2:]
    pixels = denormalize_intrinsics(cameras.intrinsics, height, width)
    x, y, there, front = project_points(inverse_depth, pixels, cameras.extrinsics, neighbours)
    return torch.where(front, x, -1.0).clamp(-1, width), torch.where(front, y, -1.0).clamp(-1, height), there


def _sample(maps: Tensor, neighbours: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Maps [views, channels, H, W] of the neighbours, bilinearly at x and y [views * n, 1, H * W], zero outside."""
    height, width = maps.shape[2:]
    table = to_tokens(bordered(maps))  # [views, bordered pixels, channels]
    first = (neighbours.flatten() * table.shape[1]).to(torch.int32)[:, None]
    corners, across, down = corners_around(x[:, 0], y[:, 0], height, width)
    rows = table.flatten(0, 1)
    around = [F.embedding(first + corner, rows) for corner in corners]  # each [pairs, H * W, channels]
    return interpolate(around, across[..., None], down[..., None]).transpose(1, 2)
