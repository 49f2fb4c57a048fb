"""The gradient of gather attention's table on a GPU, a CUDA kernel that numba compiles.

`index_add_` would need every product of a weight and a pixel's features in memory, and one atomic addition for each.
Here a warp adds the weights of a pixel's consecutive candidates first that have the same row, which neighbouring
candidates often do, since their projections are less than a pixel apart.
"""

from typing import Any

import numba.cuda
from torch import Tensor

gpu: Any = numba.cuda  # its types leave out what kernels use

THREADS = 256
WARP = 32


def scatter_add(weights: Tensor, pixels: Tensor, rows: Tensor, out: Tensor) -> None:
    """out[rows[n, c]] += weights[n, c] * pixels[n], but for the last row of `out`, which stands for "outside".

    weights, rows: [n, candidates]. pixels: [n, channels]. out: [rows, channels]. All are contiguous, on the GPU.
    """
    lanes = min(WARP, pixels.shape[1])
    together = THREADS // lanes
    blocks = -(-len(rows) // together)
    arrays = (gpu.as_cuda_array(tensor.detach()) for tensor in (weights, pixels, rows, out))
    scatter_kernel[blocks, (lanes, together)](*arrays)


@gpu.jit
def scatter_kernel(weights: Any, pixels: Any, rows: Any, out: Any) -> None:
    """A pixel for each threadIdx.y, channels over threadIdx.x."""
    pixel = gpu.blockIdx.x * gpu.blockDim.y + gpu.threadIdx.y
    if pixel >= rows.shape[0]:
        return
    outside = out.shape[0] - 1
    for channel in range(gpu.threadIdx.x, pixels.shape[1], gpu.blockDim.x):
        row, total = rows[pixel, 0], weights[pixel, 0]
        for candidate in range(1, rows.shape[1]):
            if rows[pixel, candidate] != row:
                if row != outside:
                    gpu.atomic.add(out, (row, channel), total * pixels[pixel, channel])
                row, total = rows[pixel, candidate], weights[pixel, candidate]
            else:
                total += weights[pixel, candidate]
        if row != outside:
            gpu.atomic.add(out, (row, channel), total * pixels[pixel, channel])
