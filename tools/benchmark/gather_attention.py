"""Gather attention in ONNX Runtime, in one piece and in chunks of pixels: numbers for docs/performance.md.

python -P -m idesplat.tools.benchmark.gather_attention
"""

import warnings
from contextlib import nullcontext
from typing import Annotated, NamedTuple

import numpy as np
import onnx
import onnxruntime
import torch
import typer
from torch import Tensor, nn

from ...export.graph.gather_loops import FEW, chunked, lower_custom_ops
from ...model.common.gather_attention import GatherAttention
from ...runtime.cli.terminal import run
from ...runtime.system.files import scratch_folder
from .components import run_interleaved
from .runner import thread_environment
from .worker import Prepared

PAIRS = 2
# The inputs, and their dynamic axes.
AXES = {"queries": {0: "pairs", 1: "pixels"}, "table": {0: "all"}, "rows": {0: "pairs", 2: "pixels"}}
INPUTS = tuple(AXES)


class Shape(NamedTuple):
    """Sizes of gather attention: side of the square map, candidates of a pixel, channels, pixels that candidates span.

    block: the number of pixels of a map is a multiple of it.
    """

    side: int
    candidates: int
    channels: int
    span: float
    block: int


SHAPES = {
    "IDESplat, DPBU 1": Shape(64, 257, 256, 21, 16),
    "IDESplat, DPBU 2": Shape(128, 129, 64, 4, 64),
    "IDESplat, DPBU 3": Shape(256, 65, 32, 4, 256),
    "DepthSplat, four pixels a candidate": Shape(64, 512, 128, 21, 16),
    "idesplat-tiny, DPBU 1": Shape(64, 97, 64, 21, 64),
    "idesplat-tiny, DPBU 2": Shape(128, 25, 32, 4, 256),
    "idesplat-tiny, DPBU 3": Shape(256, 9, 8, 4, 1024),
}


def main(
    repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 5,
    threads: Annotated[int, typer.Option(help="ONNX Runtime's threads.", min=1)] = 1,
) -> None:
    """Time the gathered dot product and weighted sum, on two pairs of 256x256 views."""
    with thread_environment(threads):
        for name, shape in SHAPES.items():
            candidates = {
                "in one piece": (gather_attention, shape, False, threads),
                "chunked": (gather_attention, shape, True, threads),
            }
            run_interleaved(f"{name}: gathered dot and weighted sum", candidates, repeats)


def gather_attention(shape: Shape, in_chunks: bool, threads: int) -> Prepared:
    """The gathered dot product and weighted sum, in chunks of pixels as an exported graph has them, or in one piece."""
    arrays = example(shape)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    graph = exported(shape.block, arrays, in_chunks).SerializeToString()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    feed = dict(zip(INPUTS, arrays, strict=True))

    def run() -> None:
        session.run(None, feed)

    return None, run


class Both(nn.Module):
    """The gathered dot product, then the gathered weighted sum."""

    def __init__(self, block: int) -> None:
        super().__init__()
        self.gather_attention = GatherAttention(FEW, block)

    def forward(self, queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        """As `GatherAttention`: the sum of the rows weighted by their scores, [pairs, h * w, channels]."""
        return self.gather_attention.gathered_weighted_sum(
            self.gather_attention.gathered_dot(queries, table, rows), table, rows
        )


def exported(block: int, arrays: tuple[np.ndarray, ...], in_chunks: bool) -> onnx.ModelProto:
    """`Both` as a graph with dynamic numbers of pairs and pixels."""
    network = Both(block)
    with scratch_folder() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecation of the path, and tracing warnings
        path = folder / "both.onnx"
        tensors = tuple(torch.from_numpy(array) for array in arrays)
        with chunked(network) if in_chunks else nullcontext():
            torch.onnx.export(
                network, tensors, str(path), dynamo=False, opset_version=20, input_names=list(INPUTS), dynamic_axes=AXES
            )
        return lower_custom_ops(onnx.load(path))


def example(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Queries, table and rows of two views whose epipolar lines are the image's rows."""
    rng = np.random.default_rng(0)
    pixels = shape.side**2
    row, column = np.divmod(np.arange(pixels), shape.side)
    moved = np.rint(column - np.linspace(0, shape.span, shape.candidates)[:, None]).clip(0, shape.side - 1)
    inside = (row * shape.side + moved).astype(np.int32)  # [candidates, pixels]
    table = rng.standard_normal((PAIRS * pixels + 1, shape.channels)).astype(np.float32)
    queries = rng.standard_normal((PAIRS, pixels, shape.channels)).astype(np.float32)
    return queries, table, np.stack([inside + pixels, inside])


if __name__ == "__main__":
    run(main)
