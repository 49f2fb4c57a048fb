"""Real spherical harmonics (SH) of degree 0 to 3 in the 3DGS basis, and the rotation of SH coefficients.

Colour in the unit direction d from the camera to a Gaussian is max(0.5 + sum_k Y_k(d) sh_k, 0), as in 3DGS (Kerbl et
al. 2023). Coefficient k = l^2 + l + m belongs to degree l and order m. runtime/geometry/sh.py has the same basis in
NumPy; a test holds the two equal.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

SH_0 = 0.28209479177387814  # Y of degree 0, 1 / (2 sqrt(pi))
SH_1 = 0.4886025119029199  # sqrt(3 / (4 pi))
SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Tensor, coefficients: int) -> Tensor:
    """Basis functions [..., coefficients] at unit directions [..., 3]; coefficients: 1, 4, 9 or 16."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_0)]
    if coefficients > 1:
        basis += [-SH_1 * y, SH_1 * z, -SH_1 * x]
    if coefficients > 4:
        basis += [SH_2[0] * x * y, -SH_2[0] * y * z]
        basis += [SH_2[1] * (2 * z * z - x * x - y * y)]
        basis += [-SH_2[0] * x * z, SH_2[2] * (x * x - y * y)]
    if coefficients > 9:
        basis += [-SH_3[0] * y * (3 * x * x - y * y), SH_3[1] * x * y * z]
        basis += [-SH_3[2] * y * (4 * z * z - x * x - y * y)]
        basis += [SH_3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-SH_3[2] * x * (4 * z * z - x * x - y * y)]
        basis += [SH_3[4] * z * (x * x - y * y), -SH_3[0] * x * (x * x - 3 * y * y)]
    # In memory each function's values follow each other, along which PyTorch's loops are fastest.
    return torch.stack(basis).movedim(0, -1)


def sh_rotation(rotation: Tensor, coefficients: int) -> Tensor:
    """The matrix that takes SH coefficients from the camera's frame to the world's 3DGS basis.

    The releases (gaussian_adapter.py) rotate degree l with e3nn's Wigner matrix D_l(R) and evaluate the result in a
    basis with the axes permuted to (z, x, y). The weights were trained with that rotation, so it is kept, followed by a
    change of basis B_l to the one that viewers read: sh_world = B_l D_l(R) sh_camera. D_0 is 1 and D_1 is R.

    rotation: camera-to-world, [views, 3, 3]. coefficients: 1, 4 or 9. Returns [views, coefficients, coefficients].
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
    """B_l: degree l = `band` from the releases' basis, evaluated at (z, x, y), to the 3DGS basis."""
    half, root = 0.5, math.sqrt(3) / 2
    matrices = {
        1: [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
        2: [[0, -1, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, -half, 0, root], [-1, 0, 0, 0, 0], [0, 0, -root, 0, -half]],
    }
    return torch.tensor(matrices[band], dtype=like.dtype, device=like.device)


def _wigner2(rotation: Tensor) -> Tensor:
    """D_2: e3nn's Wigner matrix of degree 2 as a polynomial of the rotation, [views, 5, 5].

    Each function of degree 2 is a quadratic form Y_k(v) = v^T B_k v with B_k symmetric and traceless. Rotation takes
    B_k to R^T B_k R, whose coordinates in the basis B are row k of the matrix.
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
    rotated = rotation.transpose(1, 2)[:, None] @ basis @ rotation[:, None]  # [views, 5, 3, 3]
    squared_norm = basis[0].square().sum()  # the same for all five
    return rotated.flatten(2) @ basis.flatten(1).transpose(0, 1) / squared_norm
