"""The sparse products in ONNX Runtime, gathered at once and in steps: numbers for docs/performance.md.

python -P -m idesplat.tools.benchmark.gather_attention
"""

import tempfile
import warnings
from contextlib import nullcontext
from pathlib import Path
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
from .components import run_interleaved
from .runner import thread_environment
from .worker import Prepared

PAIRS = 2
# The inputs, and which of their axes are open.
AXES = {"queries": {0: "pairs", 1: "pixels"}, "table": {0: "all"}, "rows": {0: "pairs", 2: "pixels"}}
INPUTS = tuple(AXES)


class Shape(NamedTuple):
    """What one product works on: square maps, candidates of a pixel, channels of a row, pixels the candidates span.

    block: of so many pixels every map has a multiple.
    """

    side: int
    candidates: int
    channels: int
    span: float
    block: int


SHAPES = {
    "IDESplat, unit 1": Shape(64, 257, 256, 21, 16),
    "IDESplat, unit 2": Shape(128, 129, 64, 4, 64),
    "IDESplat, unit 3": Shape(256, 65, 32, 4, 256),
    "DepthSplat, four pixels a candidate": Shape(64, 512, 128, 21, 16),
    "idesplat-tiny, unit 1": Shape(64, 97, 64, 21, 64),
    "idesplat-tiny, unit 2": Shape(128, 25, 32, 4, 256),
    "idesplat-tiny, unit 3": Shape(256, 9, 8, 4, 1024),
}


def main(
    repeats: Annotated[int, typer.Option(help="Rounds.", min=1)] = 5,
    threads: Annotated[int, typer.Option(help="ONNX Runtime's threads.", min=1)] = 1,
) -> None:
    """Time the correlation and the weighted sum of it, on two pairs of 256x256 views."""
    with thread_environment(threads):
        for name, shape in SHAPES.items():
            candidates = {
                "gathered at once": (products, shape, False, threads),
                "in steps": (products, shape, True, threads),
            }
            run_interleaved(f"{name}: gathered dot and weighted sum", candidates, repeats)


def products(shape: Shape, steps: bool, threads: int) -> Prepared:
    """Both products, one after the other, as an exported graph has them or gathered at once."""
    arrays = example(shape)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    graph = exported(shape.block, arrays, steps).SerializeToString()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    feed = dict(zip(INPUTS, arrays, strict=True))

    def run() -> None:
        session.run(None, feed)

    return None, run


class Both(nn.Module):
    """One product after the other."""

    def __init__(self, block: int) -> None:
        super().__init__()
        self.gather_attention = GatherAttention(FEW, block)

    def forward(self, queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        """As `GatherAttention`: the rows weighed by their scores, [pairs, h * w, channels]."""
        return self.gather_attention.gathered_weighted_sum(
            self.gather_attention.gathered_dot(queries, table, rows), table, rows
        )


def exported(block: int, arrays: tuple[np.ndarray, ...], steps: bool) -> onnx.ModelProto:
    """`Both` as a graph whose pairs and pixels are open."""
    network = Both(block)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecation of the path, and tracing warnings
        path = Path(folder) / "both.onnx"
        tensors = tuple(torch.from_numpy(array) for array in arrays)
        with chunked(network) if steps else nullcontext():
            torch.onnx.export(
                network, tensors, str(path), dynamo=False, opset_version=20, input_names=list(INPUTS), dynamic_axes=AXES
            )
        return lower_custom_ops(onnx.load(path))


def example(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Queries, table and rows of two views whose pixels look along the other's rows."""
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
