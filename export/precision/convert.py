"""Lower precisions: int8 for processors and fp16 for graphics cards, each for the parts that bear it.

What is in float32 in both: inputs and outputs, geometry, monocular depth, the sparse products, softmax, norms, the
focused module and the last convolution before the Gaussians.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import onnx

from ..graph.subgraph import sort_nodes
from .fp16 import in_fp16
from .int8 import Feeds, in_int8

FLOAT32, INT8, FP16 = PRECISIONS = ("float32", "int8", "fp16")
# By the names of the networks' parts, which name the nodes. Of the Gaussian head all but the last is in it.
TRANSFORMERS = re.compile(r"/encoder/(vit/blocks\.|transformer/)")
CONVOLUTIONS = re.compile(
    r"/(encoder/(vit|backbone)|depth|dpbu\d)/|/gaussians/(residual/|upsampler/|regressor\d/|head1/)"
)
# Tensors smaller than this stay in the graph's file.
SMALL_TENSOR = 1024  # bytes


def convert_precision(
    precision: str, graph: onnx.ModelProto, weights: Path, examples: Iterable[Feeds]
) -> onnx.ModelProto:
    """A float32 graph, whose weights are in a file beside which others may be made, in another precision.

    examples: inputs on which the ranges of what int8 stands for are found. The file of weights is replaced.
    """
    if precision == FLOAT32:
        return graph
    source = weights.with_name("float32.onnx")
    source.write_bytes(graph.SerializeToString())
    bearing = [node for node in graph.graph.node if is_quantizable(node)]
    if precision == INT8:
        made = in_int8(source, graph, bearing, examples)
    else:
        made = in_fp16(onnx.load(source), {node.name for node in bearing})
    sort_nodes(made.graph)
    weights.unlink()
    onnx.save(made, source, save_as_external_data=True, location=weights.name, size_threshold=SMALL_TENSOR)
    return onnx.load(source, load_external_data=False)


def is_quantizable(node: onnx.NodeProto) -> bool:
    """Whether a node multiplies features."""
    if node.op_type == "MatMul":
        return bool(TRANSFORMERS.match(node.name))
    return node.op_type in ("Conv", "ConvTranspose") and bool(CONVOLUTIONS.match(node.name))
