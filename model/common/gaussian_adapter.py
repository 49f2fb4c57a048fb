"""Depth and raw parameters to Gaussians in the world frame, in 3DGS conventions (the releases' gaussian_adapter.py)."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import EncoderConfig
from .geometry import Cameras, unproject
from .quaternions import matrices_to_quaternions, pairwise_product, quaternion_product
from .sh import SH_0, sh_rotation
from .surface_frame import surface_frames

# The releases shift the raw scale before softplus, so that Gaussians start at about a pixel's size.
SCALE_SHIFT = 4.0
# SH coefficients of degree l > 0 are multiplied by SH_WEIGHT * SH_DECAY**l, so that colour starts view-independent.
SH_WEIGHT = 0.1
SH_DECAY = 0.25
QUATERNION_EPSILON = 1e-8
# A pixel's raw parameters: opacity logit, offset x y, scales, quaternion xyzw in the camera's frame, then the SH
# coefficients.
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
    """A pixel's raw parameters, in the order of `BASE_SIZES`, to its Gaussian.

        mean = c + depth * R K^-1 [u + sigmoid(dx), v + sigmoid(dy), 1]   (u, v: the pixel's upper left corner)
        scale = clamp(softplus(s - 4), scale_min, scale_max), times the pixel's size at its depth if `scale_in_pixels`
        quaternion = q(R) q,  opacity = sigmoid(logit)
        with `surface_frame`: scale times the pixel's size on the surface, quaternion = q(R) q(S) q   (`surface_frames`)
        sh = M(R) (decay * sh + [(colour - 0.5) / Y_0, 0, ...])           (`sh_rotation`)

    with R and c the camera-to-world rotation and the camera centre.
    """

    sh_decay: Tensor

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.scale_min, self.scale_max, self.in_pixels = config.scale_min, config.scale_max, config.scale_in_pixels
        self.in_surface = config.surface_frame
        self.coefficients, sh_degree = config.sh_coefficients, config.sh_degree
        decay = [
            SH_WEIGHT * SH_DECAY**band if band else 1.0 for band in range(sh_degree + 1) for _ in range(2 * band + 1)
        ]
        self.register_buffer("sh_decay", torch.tensor(decay), persistent=False)

    def forward(self, raw: Tensor, depth: Tensor, images: Tensor, cameras: Cameras) -> WorldGaussians:
        """raw [views, parameters, H, W], depth [views, H, W], images [views, 3, H, W] in [0, 1] -> Gaussians."""
        base, sh = raw.flatten(2).split((BASE_PARAMETERS, 3 * self.coefficients), dim=1)
        logits, offsets, scales, rotations = base.transpose(1, 2).split(BASE_SIZES, dim=-1)
        means = unproject(depth, offsets.sigmoid(), cameras)
        scales = F.softplus(scales - SCALE_SHIFT).clamp(self.scale_min, self.scale_max)
        if self.in_pixels:
            scales = scales * self._pixel_sizes(depth, cameras)
        camera = cameras.extrinsics[:, :3, :3]
        quats = _normalise_quaternion(rotations)
        if self.in_surface:
            to_camera, sizes = surface_frames(1 / depth, cameras)
            scales, quats = scales * sizes, pairwise_product(to_camera, quats)
        quats = quaternion_product(matrices_to_quaternions(camera), quats)
        sh = self._world_sh(sh.unflatten(1, (3, self.coefficients)), (images.flatten(2) - 0.5) / SH_0, camera)
        gaussians = WorldGaussians(means, scales, quats, logits.sigmoid()[..., 0], sh)
        return WorldGaussians(*(x.flatten(0, 1) for x in gaussians))

    def _pixel_sizes(self, depth: Tensor, cameras: Cameras) -> Tensor:
        """The width of a pixel at its depth, depth / fx: [views, H * W, 1] in scene units."""
        focal = cameras.intrinsics[:, 0, 0] * depth.shape[2]
        return (depth.flatten(1) / focal[:, None])[..., None]

    def _world_sh(self, sh: Tensor, colours: Tensor, camera: Tensor) -> Tensor:
        """sh [views, 3, coefficients, H * W] as predicted, in the camera's frame -> [views, H * W, coefficients, 3].

        colours: added to degree 0, [views, 3, H * W]. camera: camera-to-world rotations, [views, 3, 3].
        """
        # Pixels stay innermost until the end: transposing three values at a time takes as long as several convolutions.
        sh = sh.transpose(1, 2) * self.sh_decay[:, None, None]
        sh = torch.cat([sh[:, :1] + colours[:, None], sh[:, 1:]], dim=1)
        to_world = sh_rotation(camera, self.coefficients)  # [views, coefficients, coefficients]
        rotated = (to_world @ sh.flatten(2)).unflatten(2, (3, -1))
        return rotated.flatten(1, 2).transpose(1, 2).unflatten(2, (self.coefficients, 3))


def _normalise_quaternion(xyzw: Tensor) -> Tensor:
    """Raw xyzw -> unit wxyz."""
    unit = xyzw / (xyzw.norm(dim=-1, keepdim=True) + QUATERNION_EPSILON)
    return torch.cat([unit[..., 3:], unit[..., :3]], dim=-1)
