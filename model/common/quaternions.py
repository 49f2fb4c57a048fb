"""Unit quaternions in the order wxyz, without branches on the data, so that they can be exported."""

import torch
from torch import Tensor


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


def matrices_to_quaternions(rotation: Tensor) -> Tensor:
    """Rotations [views, 3, 3] -> unit quaternions wxyz [views, 4].

    Row i of `candidates` is 4 q_i q, whose diagonal is 4 q_i^2. The row with the largest q_i is normalised; its length
    is never small (Shepperd's method).
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


def quaternions_to_matrices(quats: Tensor) -> Tensor:
    """Quaternions wxyz of any length but zero [..., 4] -> rotations [..., 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
