"""The frame of the surface that a depth map shows at each pixel, for Gaussians' scales and rotations."""

import torch
import torch.nn.functional as F
from torch import Tensor

from .geometry import Cameras, invert_intrinsics, pixel_grid

# Steeper surfaces count as this steep: the relative change of inverse depth for a step of one across the ray.
MAX_SLOPE = 2.0
# A normal that points straight at the camera has no least rotation; no surface that is seen has one.
MIN_COSINE = -0.99


def surface_frames(inverse_depth: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Rotations from the surface's frame to the camera's, and the size of a pixel on the surface.

    The surface's z axis is its normal, on the side away from the camera; its x and y axes are the camera's, turned by
    the least rotation. With the ray r = [x, y, 1] of a pixel, a plane n . P = d has the inverse depth w = n . r / d, so

        n ~ [a, b, 1 - x a - y b]   for the slopes   a = (dw / dx) / w,  b = (dw / dy) / w,

    and a step of one across the ray along x moves the point P = r / w by (e_x - a r) / w, along y by (e_y - b r) / w.

    inverse_depth: [views, H, W]. Returns quaternions wxyz, [views, H * W, 4], and the lengths of these steps times w,
    which are 1 for a surface that faces the camera, with 1 for the normal, [views, H * W, 3].
    """
    _, height, width = inverse_depth.shape
    u, v = pixel_grid(height, width, inverse_depth)
    centres = torch.stack([(u + 0.5) / width, (v + 0.5) / height, torch.ones_like(u)])
    x, y, one = (invert_intrinsics(cameras.intrinsics) @ centres).unbind(1)  # [views, H * W]
    a = _slopes(inverse_depth, cameras.intrinsics[:, 0, 0] * width)
    b = _slopes(inverse_depth.transpose(1, 2), cameras.intrinsics[:, 1, 1] * height).transpose(1, 2)
    a, b = a.flatten(1), b.flatten(1)
    nx, ny, nz = F.normalize(torch.stack([a, b, 1 - x * a - y * b]), dim=0).unbind()
    quats = torch.stack([1 + nz.clamp(min=MIN_COSINE), -ny, nx, torch.zeros_like(nx)], dim=-1)
    along_x = torch.stack([1 - x * a, y * a, a]).norm(dim=0)
    along_y = torch.stack([x * b, 1 - y * b, b]).norm(dim=0)
    return F.normalize(quats, dim=-1), torch.stack([along_x, along_y, one], dim=-1)


def _slopes(inverse_depth: Tensor, focal: Tensor) -> Tensor:
    """(dw / dx) / w along the rows of [views, H, W], of the less different neighbour: an edge belongs to one side.

    focal: in pixels, [views].
    """
    steps = inverse_depth[..., 1:] - inverse_depth[..., :-1]
    forward, backward = torch.cat([steps, steps[..., -1:]], dim=-1), torch.cat([steps[..., :1], steps], dim=-1)
    lesser = torch.where(forward.abs() < backward.abs(), forward, backward)
    return (focal[:, None, None] * lesser / inverse_depth).clamp(-MAX_SLOPE, MAX_SLOPE)
