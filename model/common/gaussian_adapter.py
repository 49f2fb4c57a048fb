"""Depth and raw parameters to Gaussians in the world frame, in the usual 3DGS conventions (gaussian_adapter.py)."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import EncoderConfig
from .geometry import Cameras, invert_intrinsics, pixel_grid

# The releases shift the raw scale before softplus, so that splats start at about pixel size.
SCALE_SHIFT = 4.0
# Spherical harmonics of band l are multiplied by SH_SHARE * SH_DECAY**l, so that colour starts view-independent.
SH_SHARE = 0.1
SH_DECAY = 0.25
# The constant value of the spherical harmonic of degree 0.
SH_C0 = 0.28209479177387814
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


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """The rotation b followed by a, all wxyz [..., 4]."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(product, dim=-1)


def quaternion_from_matrix(rotation: Tensor) -> Tensor:
    """Rotations [views, 3, 3] -> unit quaternions wxyz [views, 4], without a branch on the data.

    Of the four usual solutions the one with the largest divisor is taken, which is never small.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation.flatten(-2).unbind(-1)
    candidates = [
        [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
        [m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20],
        [m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12],
        [m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22],
    ]
    stacked = torch.stack([torch.stack(row, dim=-1) for row in candidates], dim=-2)  # [views, 4, 4]
    best = torch.stack([candidates[i][i] for i in range(4)], dim=-1).argmax(-1)  # [views]
    chosen = stacked.gather(-2, best[:, None, None].expand(-1, 1, 4))[:, 0]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def harmonic_rotation(rotation: Tensor, coefficients: int) -> Tensor:
    """Camera rotations [views, 3, 3] -> the matrix that takes harmonics as predicted to the world's 3DGS basis.

    The releases rotate the bands with e3nn's Wigner matrices and evaluate them at (z, x, y). The rotation is kept as it
    is, since the weights were trained with it, and then the basis is changed to the one every viewer reads.
    Degree 2 and below. Returns [views, coefficients, coefficients].
    """
    blocks = [torch.ones_like(rotation[:, :1, :1])]
    if coefficients > 1:
        blocks.append(_to_3dgs(1, rotation) @ rotation)
    if coefficients > 4:
        blocks.append(_to_3dgs(2, rotation) @ _wigner2(rotation))
    rows, start = [], 0
    for block in blocks:
        size = block.shape[-1]
        rows.append(F.pad(block, (start, coefficients - start - size)))
        start += size
    return torch.cat(rows, dim=1)


def _to_3dgs(band: int, like: Tensor) -> Tensor:
    """One band from the releases' basis, evaluated at (z, x, y), to the 3DGS basis."""
    half, root = 0.5, math.sqrt(3) / 2
    matrices = {
        1: [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
        2: [[0, -1, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, -half, 0, root], [-1, 0, 0, 0, 0], [0, 0, -root, 0, -half]],
    }
    return torch.tensor(matrices[band], dtype=like.dtype, device=like.device)


def _wigner2(rotation: Tensor) -> Tensor:
    """e3nn's Wigner matrix of degree 2 as a polynomial of the rotation, [views, 5, 5].

    Each harmonic is a quadratic form v' B v with B symmetric and traceless; a rotation turns B into R' B R, whose
    coordinates in the basis B are the matrix's row.
    """
    c, h = math.sqrt(3) / 2, 0.5
    forms = [
        [[0, 0, c], [0, 0, 0], [c, 0, 0]],  # sqrt(3) x z
        [[0, c, 0], [c, 0, 0], [0, 0, 0]],  # sqrt(3) x y
        [[-h, 0, 0], [0, 1, 0], [0, 0, -h]],  # y^2 - (x^2 + z^2) / 2
        [[0, 0, 0], [0, 0, c], [0, c, 0]],  # sqrt(3) y z
        [[-c, 0, 0], [0, 0, 0], [0, 0, c]],  # sqrt(3) / 2 (z^2 - x^2)
    ]
    basis = torch.tensor(forms, dtype=rotation.dtype, device=rotation.device)
    turned = rotation.transpose(1, 2)[:, None] @ basis @ rotation[:, None]  # [views, 5, 3, 3]
    squared_norm = basis[0].square().sum()  # the same for all five
    return turned.flatten(2) @ basis.flatten(1).transpose(0, 1) / squared_norm
