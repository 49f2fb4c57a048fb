"""Unit quaternions in the order wxyz, without branches on the data, so that they can be exported."""

import torch
from torch import Tensor

# The product's component i is the sum of SIGNS[i][j] a[PARTNERS[i][j]] b[j].
PARTNERS = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0))
SIGNS = ((1, -1, -1, -1), (1, 1, -1, 1), (1, 1, 1, -1), (1, -1, 1, 1))
# 4 q_i q_j of a rotation's quaternion is 1 (where i = j) plus a sum of the matrix's nine entries, row by row.
ENTRIES = (
    *((1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 0, 0, 0, 0, -1, 0, 1, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0)),
    *((0, -1, 0, 1, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, -1, 0, 1, 0), (1, 0, 0, 0, -1, 0, 0, 0, -1)),
    *((0, 1, 0, 1, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0, 1, 0, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0)),
    *((0, 1, 0, 1, 0, 0, 0, 0, 0), (-1, 0, 0, 0, 1, 0, 0, 0, -1), (0, 0, 0, 0, 0, 1, 0, 1, 0)),
    *((0, -1, 0, 1, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0, 1, 0, 0), (0, 0, 0, 0, 0, 1, 0, 1, 0)),
    (-1, 0, 0, 0, -1, 0, 0, 0, 1),
)


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """The rotations b [views, n, 4] followed by a [views, 4], all wxyz: [views, n, 4].

    A matrix product: component by component it would be forty nodes of a graph.
    """
    signs = torch.tensor(SIGNS, dtype=a.dtype, device=a.device)
    left = torch.stack([a[:, list(row)] for row in PARTNERS], dim=1) * signs  # [views, 4, 4]
    return b @ left.transpose(1, 2)


def pairwise_product(a: Tensor, b: Tensor) -> Tensor:
    """The rotations b followed by a, each of its own, both wxyz [..., 4]."""
    left, right = a.unbind(-1), b.unbind(-1)
    rows = []
    for partners, signs in zip(PARTNERS, SIGNS, strict=True):
        w, x, y, z = (sign * left[partner] * other for sign, partner, other in zip(signs, partners, right, strict=True))
        rows.append(w + x + y + z)
    return torch.stack(rows, dim=-1)


def matrices_to_quaternions(rotation: Tensor) -> Tensor:
    """Rotations [views, 3, 3] -> unit quaternions wxyz [views, 4].

    Row i of `candidates` is 4 q_i q, whose diagonal is 4 q_i^2. The row with the largest q_i is normalised; its length
    is never small (Shepperd's method). It is chosen by comparisons: WebGPU cannot compute with an index.
    """
    entries = torch.tensor(ENTRIES, dtype=rotation.dtype, device=rotation.device)
    ones = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    candidates = (rotation.flatten(-2) @ entries.T).unflatten(-1, (4, 4)) + ones  # [views, 4, 4]
    chosen, *others = candidates.unbind(1)
    largest = chosen[:, :1]
    for index, candidate in enumerate(others, 1):
        size = candidate[:, index : index + 1]
        chosen = torch.where(size > largest, candidate, chosen)
        largest = torch.maximum(largest, size)
    return chosen / chosen.norm(dim=-1, keepdim=True)


def quaternions_to_matrices(quats: Tensor) -> Tensor:
    """Quaternions wxyz of any length but zero [..., 4] -> rotations [..., 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    # In memory each entry's values follow each other, along which PyTorch's loops are fastest.
    return torch.stack(rows).unflatten(0, (3, 3)).movedim((0, 1), (-2, -1))
