"""Spherical harmonics."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# The constant value of the spherical harmonic of degree 0.
SH_C0 = 0.28209479177387814


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
