"""Depth and raw parameters to Gaussians in the world frame, in the usual 3DGS conventions (gaussian_adapter.py)."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import EncoderConfig
from .geometry import Cameras, invert_intrinsics, pixel_grid
from .quaternions import quaternion_from_matrix, quaternion_product
from .sh import SH_C0, harmonic_rotation

# The releases shift the raw scale before softplus, so that splats start at about pixel size.
SCALE_SHIFT = 4.0
# Spherical harmonics of band l are multiplied by SH_SHARE * SH_DECAY**l, so that colour starts view-independent.
SH_SHARE = 0.1
SH_DECAY = 0.25
QUATERNION_EPSILON = 1e-8
# What a pixel's raw parameters begin with: opacity logit, offset x y, scales, quaternion xyzw in the camera's frame.
# The harmonics come behind it.
BASE_SIZES = (1, 2, 3, 4)
BASE_PARAMETERS = sum(BASE_SIZES)


class WorldGaussians(NamedTuple):
    """Gaussians in the world frame, ordered by view, row, column."""

    means: Tensor  # [gaussians, 3]
    scales: Tensor  # [gaussians, 3]
    quats: Tensor  # [gaussians, 4] wxyz
    opacities: Tensor  # [gaussians]
    sh: Tensor  # [gaussians, coefficients, 3]


class GaussianAdapter(nn.Module):
    """A pixel's raw parameters, as `BASE_SIZES` orders them, to its Gaussian."""

    sh_decay: Tensor

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.scale_min, self.scale_max, self.in_pixels = config.scale_min, config.scale_max, config.scale_in_pixels
        self.coefficients, sh_degree = config.sh_coefficients, config.sh_degree
        decay = [
            SH_SHARE * SH_DECAY**band if band else 1.0 for band in range(sh_degree + 1) for _ in range(2 * band + 1)
        ]
        self.register_buffer("sh_decay", torch.tensor(decay), persistent=False)

    def forward(self, raw: Tensor, depth: Tensor, images: Tensor, cameras: Cameras) -> WorldGaussians:
        """raw [views, parameters, H, W], depth [views, H, W], images [views, 3, H, W] in [0, 1] -> Gaussians."""
        base, sh = raw.flatten(2).split((BASE_PARAMETERS, 3 * self.coefficients), dim=1)
        logits, offsets, scales, rotations = base.transpose(1, 2).split(BASE_SIZES, dim=-1)
        means = self._means(offsets.sigmoid(), depth, cameras)
        scales = F.softplus(scales - SCALE_SHIFT).clamp(self.scale_min, self.scale_max)
        if self.in_pixels:
            scales = scales * self._pixel_sizes(depth, cameras)
        camera = cameras.extrinsics[:, :3, :3]
        quats = quaternion_product(quaternion_from_matrix(camera)[:, None], _normalise_quaternion(rotations))
        sh = self._world_harmonics(sh.unflatten(1, (3, self.coefficients)), (images.flatten(2) - 0.5) / SH_C0, camera)
        gaussians = WorldGaussians(means, scales, quats, logits.sigmoid()[..., 0], sh)
        return WorldGaussians(*(x.flatten(0, 1) for x in gaussians))

    def _means(self, offsets: Tensor, depth: Tensor, cameras: Cameras) -> Tensor:
        """Pixels, moved by the offset within themselves, at their depth: [views, H * W, 3] in the world."""
        _, height, width = depth.shape
        x, y = pixel_grid(height, width, depth)
        x = (x + offsets[..., 0]) / width  # [views, H * W]
        y = (y + offsets[..., 1]) / height
        rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ invert_intrinsics(cameras.intrinsics).transpose(1, 2)
        rotation, centre = cameras.extrinsics[:, :3, :3], cameras.extrinsics[:, None, :3, 3]
        return centre + rays @ rotation.transpose(1, 2) * depth.flatten(1)[..., None]

    def _pixel_sizes(self, depth: Tensor, cameras: Cameras) -> Tensor:
        """What a pixel's width covers at its depth, [views, H * W, 1] in scene units."""
        focal = cameras.intrinsics[:, 0, 0] * depth.shape[2]
        return (depth.flatten(1) / focal[:, None])[..., None]

    def _world_harmonics(self, sh: Tensor, colours: Tensor, camera: Tensor) -> Tensor:
        """sh [views, 3, coefficients, H * W] as predicted, in the camera's frame -> [views, H * W, coefficients, 3].

        colours: what is added to the band 0, [views, 3, H * W].
        """
        # Pixels stay innermost until the end: moving three numbers at a time takes as long as several convolutions.
        sh = sh.transpose(1, 2) * self.sh_decay[:, None, None]
        sh = torch.cat([sh[:, :1] + colours[:, None], sh[:, 1:]], dim=1)
        to_world = harmonic_rotation(camera, self.coefficients)  # [views, coefficients, coefficients]
        turned = (to_world @ sh.flatten(2)).unflatten(2, (3, -1))
        return turned.flatten(1, 2).transpose(1, 2).unflatten(2, (self.coefficients, 3))


def _normalise_quaternion(xyzw: Tensor) -> Tensor:
    """Raw xyzw -> unit wxyz."""
    unit = xyzw / (xyzw.norm(dim=-1, keepdim=True) + QUATERNION_EPSILON)
    return torch.cat([unit[..., 3:], unit[..., :3]], dim=-1)
