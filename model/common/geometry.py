"""Cameras and projections in closed form: rigid inverses, neighbours, and where a pixel lands in another view.

Extrinsics are camera-to-world with OpenCV axes (x right, y down, z forward); intrinsics [views, 3, 3] have no skew.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .layers import repeat_views

# A projection nearer to the camera plane than this, in scene units, counts as behind the camera (matching.py).
MIN_DEPTH = 1e-3
# With this many views or fewer, the neighbours keep the order of the views; with more, they come nearest first.
ORDERED_VIEWS = 3


class Cameras(NamedTuple):
    """What the geometry needs of the views."""

    extrinsics: Tensor  # [views, 4, 4] camera-to-world, OpenCV axes
    intrinsics: Tensor  # [views, 3, 3] normalised by width and height
    near: Tensor  # [views]
    far: Tensor  # [views]

    def inverse_range(self) -> tuple[Tensor, Tensor]:
        """The inverse depths of the far and of the near end, each [views, 1, 1, 1] to meet maps."""
        return (1 / self.far)[:, None, None, None], (1 / self.near)[:, None, None, None]


def invert_rigid(transform: Tensor) -> Tensor:
    """Inverse of rigid transforms [..., 4, 4], without a linear solver."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    translation = -rotation @ transform[..., :3, 3:]
    return torch.cat([torch.cat([rotation, translation], dim=-1), transform[..., 3:, :]], dim=-2)


def invert_intrinsics(intrinsics: Tensor) -> Tensor:
    """Inverse of skewless intrinsics [views, 3, 3]."""
    fx, fy = intrinsics[..., 0, 0], intrinsics[..., 1, 1]
    cx, cy = intrinsics[..., 0, 2], intrinsics[..., 1, 2]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [1 / fx, zero, -cx / fx, zero, 1 / fy, -cy / fy, zero, zero, one]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def scale_intrinsics(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Intrinsics normalised by image size -> in pixels of a map of the given size."""
    return torch.cat([intrinsics[:, :1] * width, intrinsics[:, 1:2] * height, intrinsics[:, 2:]], dim=1)


def pixel_grid(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Integer pixel coordinates as floats: x and y, each [height * width], row by row."""
    x = torch.arange(width, device=like.device).to(like.dtype)
    y = torch.arange(height, device=like.device).to(like.dtype)
    return x.repeat(height), y[:, None].expand(-1, width).flatten()


def nearest_views(extrinsics: Tensor, count: int) -> Tensor:
    """The views that each view is matched with: up to `count` others by distance of the camera centres.

    With `ORDERED_VIEWS` or fewer these are all others in their given order, as in the releases, where the order
    decides which pairs share the U-Net's cross-view attention.

    extrinsics: [views, 4, 4]. Returns indices [views, neighbours], neighbours = min(views - 1, count).
    """
    views = extrinsics.shape[0]
    centres = extrinsics[:, :3, 3]
    distance = (centres[:, None] - centres[None]).square().sum(-1)  # [views, views]
    index = torch.arange(views, device=extrinsics.device)
    order = index.to(distance.dtype).expand(views, views)
    # The number of views as a tensor, so that one exported graph serves any number.
    many = torch.ones_like(centres[:, 0]).sum() > ORDERED_VIEWS
    itself = index[:, None] == index[None]
    key = torch.where(itself, torch.inf, torch.where(many, distance, order))
    # Slices stop at the end by themselves: the view itself is last, and fewer than `count` others are no special case.
    return key.argsort(dim=1)[:, :-1][:, :count]


def project_points(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where each pixel of each view lands in its neighbours, for each of its inverse depths.

    inverse_depth: in 1 / scene units, [views, candidates, h, w].
    intrinsics: in pixels of the same map, [views, 3, 3]; pixel centres at integers, as the releases warp.
    extrinsics: [views, 4, 4]. neighbours: [views, n].
    Returns x and y in pixels, the inverse depth there and whether the point lies before the camera, each
    [views * n, candidates, h * w].
    """
    _, _, height, width = inverse_depth.shape
    relative = (invert_rigid(extrinsics)[neighbours] @ extrinsics[:, None]).flatten(0, 1)  # [pairs, 4, 4]
    target = intrinsics[neighbours].flatten(0, 1)[..., None]  # [pairs, 3, 3, 1]
    grid_x, grid_y = pixel_grid(height, width, inverse_depth)
    rays = invert_intrinsics(intrinsics) @ torch.stack([grid_x, grid_y, torch.ones_like(grid_x)])  # [views, 3, h * w]
    count = neighbours.shape[1]
    rays = relative[:, :3, :3] @ repeat_views(rays, count)  # [pairs, 3, h * w]
    inverse = repeat_views(inverse_depth.flatten(2), count)  # [pairs, candidates, h * w]

    # A point at inverse depth w is (ray + shift * w) / w. The division by w cancels in the projection.
    x, y, z = (rays[:, axis : axis + 1] + relative[:, axis : axis + 1, 3:] * inverse for axis in range(3))
    x = x / z * target[:, 0, 0:1] + target[:, 0, 2:3]
    y = y / z * target[:, 1, 1:2] + target[:, 1, 2:3]
    return x, y, inverse / z, z > MIN_DEPTH * inverse


def project_candidates(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`project_points` without the inverse depth there."""
    x, y, _, front = project_points(inverse_depth, intrinsics, extrinsics, neighbours)
    return x, y, front


def nearest_pixels(inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor) -> Tensor:
    """The warp indices of IDESplat: the row, in a table of all views' pixels, that each candidate falls on.

    Arguments as for `project_candidates`. Returns int32 [views * n, candidates, h * w] with values in
    [0, views * h * w]; the last row stands for "outside", whose feature is zero.
    """
    views, _, height, width = inverse_depth.shape
    with torch.no_grad():
        x, y, valid = project_candidates(inverse_depth, intrinsics, extrinsics, neighbours)
        valid = valid & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        pixel = (y.round() * width + x.round()).to(torch.int32)
        first = (neighbours.flatten() * (height * width)).to(torch.int32)
        return torch.where(valid, pixel + first[:, None, None], views * height * width)


def sampling_points(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor]:
    """Where DepthSplat's warp looks: x and y in pixels, each [views * n, candidates, h * w].

    Arguments as for `project_candidates`. What lies outside or behind the camera is brought to one pixel from the
    map's border, where zero padding leaves nothing of it.
    """
    _, _, height, width = inverse_depth.shape
    with torch.no_grad():
        x, y, front = project_candidates(inverse_depth, intrinsics, extrinsics, neighbours)
        return torch.where(front, x, -1.0).clamp(-1, width), torch.where(front, y, -1.0).clamp(-1, height)
