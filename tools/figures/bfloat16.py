"""Change of predicted depth when one part of a network multiplies in bfloat16: numbers for docs/performance.md.

python -P -m idesplat.tools.figures.bfloat16 [MODEL]

A CPU that multiplies in bfloat16 and accumulates in float32 is emulated: operands are rounded before each matmul.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import onnx
import typer
from rich.console import Console
from rich.table import Table

from ...runtime.cli.terminal import run
from ...runtime.inference.bundled_model import bundled_model
from ...runtime.inference.model_files import read_model
from ...runtime.inference.session import open_session, run_session
from ...runtime.system.progress import progress
from ..evaluation.cases import synthetic_case
from ..synthetic.sampler import HELD_OUT_SEEDS

MATMULS = ("MatMul", "Conv", "ConvTranspose")
VIEWS = 2


def main(
    model: Annotated[Path | None, typer.Argument(help="A .onnx file instead of the bundled model.")] = None,
    scenes: Annotated[int, typer.Option(help="Held-out synthetic scenes to measure on.", min=1)] = 3,
) -> None:
    """Round the operands of one part at a time, and compare depth with that of the float32 model."""
    path = model or bundled_model()
    own = read_model(path).metadata
    cases = [synthetic_case(seed, VIEWS, VIEWS, 1, own.height, own.width) for seed in HELD_OUT_SEEDS[:scenes]]
    feeds = [
        {
            "images": case.context.images,
            "extrinsics": case.context.extrinsics,
            "intrinsics": case.context.intrinsics,
            "near": np.full(VIEWS, case.near, np.float32),
            "far": np.full(VIEWS, case.far, np.float32),
        }
        for case in cases
    ]
    graph = onnx.load(path)
    exact = _depths(graph, feeds)
    table = Table("part", "all matmuls", "matmuls with weights", title="median relative change of depth, largest")
    parts = dict.fromkeys(node.name.split("/")[1] for node in graph.graph.node if node.op_type in MATMULS)
    for part in progress(parts, "rounding"):
        found = [_depths(_rounded(graph, part, weighted), feeds) for weighted in (False, True)]
        table.add_row(part, *(f"{_change(depths, exact):.0e}" for depths in found))
    Console().print(table)


def _rounded(graph: onnx.ModelProto, part: str, weighted: bool) -> onnx.ModelProto:
    """The graph with bfloat16 operands of one part's matmuls; weighted: only of those with trained weights."""
    copy = onnx.ModelProto()
    copy.CopyFrom(graph)
    weights = {tensor.name for tensor in graph.graph.initializer}
    nodes: list[onnx.NodeProto] = []
    rounded: set[str] = set()
    for node in copy.graph.node:
        inside = node.op_type in MATMULS and node.name.startswith(f"/{part}/")
        if inside and (not weighted or node.input[1] in weights):
            for index, name in enumerate(node.input[:2]):
                if name not in rounded:
                    nodes += _rounding(name)
                    rounded.add(name)
                node.input[index] = f"{name}.rounded"
        nodes.append(node)
    del copy.graph.node[:]
    copy.graph.node.extend(nodes)
    return copy


def _rounding(name: str) -> tuple[onnx.NodeProto, onnx.NodeProto]:
    """Nodes that cast a tensor to bfloat16 and back."""
    short = f"{name}.bfloat16"
    return (
        onnx.helper.make_node("Cast", [name], [short], name=short, to=onnx.TensorProto.BFLOAT16),
        onnx.helper.make_node("Cast", [short], [f"{name}.rounded"], name=f"{name}.rounded", to=onnx.TensorProto.FLOAT),
    )


def _depths(graph: onnx.ModelProto, feeds: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
    session = open_session(graph.SerializeToString())
    return [run_session(session, feed)["depth"] for feed in feeds]


def _change(found: list[np.ndarray], exact: list[np.ndarray]) -> float:
    """The largest of the scenes' median relative differences."""
    return max(float(np.median(np.abs(a / b - 1))) for a, b in zip(found, exact, strict=True))


if __name__ == "__main__":
    run(main)
