"""Cameras in closed form: inverses, normalised and pixel intrinsics, neighbouring views, projection between views.

Extrinsics are camera-to-world with OpenCV axes (x right, y down, z forward); intrinsics [views, 3, 3] have no skew.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .layers import repeat_views

# A projection nearer to the camera plane than this, in scene units, counts as behind the camera (matching.py).
MIN_DEPTH = 1e-3
# With at most this many views, neighbours keep the order of the views; with more, the nearest come first.
ORDERED_VIEWS = 3


class Cameras(NamedTuple):
    """Poses, intrinsics and depth ranges of the views."""

    extrinsics: Tensor  # [views, 4, 4] camera-to-world, OpenCV axes
    intrinsics: Tensor  # [views, 3, 3] normalised by width and height
    near: Tensor  # [views]
    far: Tensor  # [views]

    def inverse_range(self) -> tuple[Tensor, Tensor]:
        """The inverse depths 1 / far and 1 / near, each [views, 1, 1, 1]."""
        return (1 / self.far)[:, None, None, None], (1 / self.near)[:, None, None, None]


def invert_rigid(transform: Tensor) -> Tensor:
    """Inverse [R^T, -R^T t] of rigid transforms [R, t], [..., 4, 4]: ONNX has no linear solver."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    translation = -rotation @ transform[..., :3, 3:]
    return torch.cat([torch.cat([rotation, translation], dim=-1), transform[..., 3:, :]], dim=-2)


def invert_intrinsics(intrinsics: Tensor) -> Tensor:
    """Inverse of intrinsics without skew, [views, 3, 3]."""
    fx, fy = intrinsics[..., 0, 0], intrinsics[..., 1, 1]
    cx, cy = intrinsics[..., 0, 2], intrinsics[..., 1, 2]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [1 / fx, zero, -cx / fx, zero, 1 / fy, -cy / fy, zero, zero, one]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def denormalize_intrinsics(intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Normalised intrinsics [views, 3, 3] -> in pixels of a map of this size."""
    return torch.cat([intrinsics[:, :1] * width, intrinsics[:, 1:2] * height, intrinsics[:, 2:]], dim=1)


def pixel_grid(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Integer pixel coordinates as floats: x and y, each [height * width], row by row."""
    x = torch.arange(width, device=like.device).to(like.dtype)
    y = torch.arange(height, device=like.device).to(like.dtype)
    return x.repeat(height), y[:, None].expand(-1, width).flatten()


def unproject(depth: Tensor, offsets: Tensor, cameras: Cameras) -> Tensor:
    """The points in the world that lie in the pixels of depth maps, [views, H * W, 3].

    depth: z-depth, [views, H, W]. offsets: of each point from its pixel's upper left corner, (x, y) in [0, 1],
    [views, H * W, 2].
    """
    _, height, width = depth.shape
    x, y = pixel_grid(height, width, depth)
    x = (x + offsets[..., 0]) / width  # [views, H * W]
    y = (y + offsets[..., 1]) / height
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ invert_intrinsics(cameras.intrinsics).transpose(1, 2)
    rotation, centre = cameras.extrinsics[:, :3, :3], cameras.extrinsics[:, None, :3, 3]
    return centre + rays @ rotation.transpose(1, 2) * depth.flatten(1)[..., None]


def nearest_views(extrinsics: Tensor, count: int) -> Tensor:
    """The views that each view is matched with: the `count` others with the nearest camera centres.

    With `ORDERED_VIEWS` or fewer these are all others in the given order, as in the releases: the order decides which
    pairs share the U-Net's cross-view attention.

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
    # The view itself sorts last. A slice beyond the end is cut, so fewer than `count` others need no special case.
    return key.argsort(dim=1)[:, :-1][:, :count]


def project_points(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Projection of each pixel of each view into its neighbours, at each of its inverse depths.

    Pixel p = [u, v, 1] of view i at inverse depth w is the point X = K_i^-1 p / w. With the relative pose [R, t] from i
    to neighbour j, its projection is K_j (R X + t) ~ K_j (R K_i^-1 p + t w): the division by w cancels, so w = 0 (a
    point at infinity) needs no special case. The inverse depth in j is w / z, z being the last component.

    inverse_depth: in 1 / scene units, [views, candidates, h, w].
    intrinsics: in pixels of the same map, [views, 3, 3]; pixel centres at integers, as the releases warp.
    extrinsics: [views, 4, 4]. neighbours: [views, n].
    Returns x and y in pixels, the inverse depth in the neighbour, and whether the point is in front of the camera, each
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

    x, y, z = (rays[:, axis : axis + 1] + relative[:, axis : axis + 1, 3:] * inverse for axis in range(3))
    x = x / z * target[:, 0, 0:1] + target[:, 0, 2:3]
    y = y / z * target[:, 1, 1:2] + target[:, 1, 2:3]
    return x, y, inverse / z, z > MIN_DEPTH * inverse


def project_candidates(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`project_points` without the inverse depth in the neighbour."""
    x, y, _, front = project_points(inverse_depth, intrinsics, extrinsics, neighbours)
    return x, y, front


def warp_indices(inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor) -> Tensor:
    """Warp indices (IDESplat, section 2): I^{j->i}(x, m), the pixel of view j that pixel x sees at candidate m.

    The index is that of the nearest pixel in the concatenated pixels of all views, j * h * w + round(y) * w + round(x).
    Arguments as for `project_points`. Returns int32 [views * n, candidates, h * w] with values in [0, views * h * w];
    the last value stands for projections outside the image or behind the camera, whose feature is zero.
    """
    views, _, height, width = inverse_depth.shape
    with torch.no_grad():
        x, y, valid = project_candidates(inverse_depth, intrinsics, extrinsics, neighbours)
        valid = valid & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        pixel = (y.round() * width + x.round()).to(torch.int32)
        first = first_rows(neighbours, views, height * width)
        return torch.where(valid, pixel + first[:, None, None], views * height * width)


def first_rows(neighbours: Tensor, views: int, pixels: int) -> Tensor:
    """The first row of each neighbour in a table of the pixels of all views: int32 [views * n].

    Looked up, not multiplied: WebGPU cannot compute with the int64 of indices.
    """
    rows = torch.arange(views, device=neighbours.device).to(torch.int32) * pixels
    return rows[neighbours].flatten()


def sampling_points(
    inverse_depth: Tensor, intrinsics: Tensor, extrinsics: Tensor, neighbours: Tensor
) -> tuple[Tensor, Tensor]:
    """Sampling positions of a bilinear warp with zero padding: x and y in pixels, each [views * n, candidates, h * w].

    Arguments as for `project_points`. Positions outside the map or behind the camera are clamped to one pixel beyond
    the border, where zero padding makes the sample zero.
    """
    _, _, height, width = inverse_depth.shape
    with torch.no_grad():
        x, y, front = project_candidates(inverse_depth, intrinsics, extrinsics, neighbours)
        return torch.where(front, x, -1.0).clamp(-1, width), torch.where(front, y, -1.0).clamp(-1, height)
