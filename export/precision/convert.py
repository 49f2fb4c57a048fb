"""Conversion of a traced graph to a lower precision: int8 for CPUs, fp16 and int8-qdq for GPUs and NPUs.

Each network family says which layers may be converted (`QuantizableLayers` of model/family.py); all others stay in
float32.
"""

from collections.abc import Iterable
from pathlib import Path

import onnx

from ...model.family import QuantizableLayers
from ..graph.subgraph import sort_nodes
from .fp16 import in_fp16
from .int8 import Feeds, in_int8
from .int8_qdq import in_int8_qdq

FLOAT32, INT8, INT8_QDQ, FP16 = PRECISIONS = ("float32", "int8", "int8-qdq", "fp16")
# Smaller tensors stay in the graph's file.
SMALL_TENSOR = 1024  # bytes


def convert_precision(
    precision: str, graph: onnx.ModelProto, weights: Path, layers: QuantizableLayers, examples: Iterable[Feeds]
) -> onnx.ModelProto:
    """A float32 graph in another precision.

    weights: the file of its weights, which is replaced; intermediate files are written beside it. layers: the ones to
    convert. examples: inputs on which the ranges of int8 activations are calibrated.
    """
    if precision == FLOAT32:
        return graph
    source = weights.with_name("float32.onnx")
    source.write_bytes(graph.SerializeToString())
    chosen = [node for node in graph.graph.node if is_quantizable(node, layers)]
    if precision == INT8:
        made = in_int8(source, graph, chosen, examples)
    elif precision == INT8_QDQ:
        made = in_int8_qdq(source, graph, chosen, examples)
    else:
        made = in_fp16(onnx.load(source), {node.name for node in chosen})
    sort_nodes(made.graph)
    weights.unlink()
    onnx.save(made, source, save_as_external_data=True, location=weights.name, size_threshold=SMALL_TENSOR)
    return onnx.load(source, load_external_data=False)


def is_quantizable(node: onnx.NodeProto, layers: QuantizableLayers) -> bool:
    """Whether a node is a matrix product or a convolution of these layers, which its name tells."""
    if node.op_type == "MatMul":
        return bool(layers.matmuls.match(node.name))
    return node.op_type in ("Conv", "ConvTranspose") and bool(layers.convolutions.match(node.name))
