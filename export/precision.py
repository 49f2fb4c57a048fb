"""Lower precisions: int8 for processors and fp16 for graphics cards, each for the parts that bear it.

What is in float32 in both: inputs and outputs, geometry, monocular depth, the sparse products, softmax, norms, the
focused module and the last convolution before the Gaussians.
"""

import math
import re
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import QuantType, quantize_dynamic

from ..runtime.session import open_session, run_session
from .stages import names_read

FLOAT32, INT8, FP16 = PRECISIONS = ("float32", "int8", "fp16")
# By the names of the networks' parts, which name the nodes. Of the Gaussian head all but the last is in it.
TRANSFORMERS = re.compile(r"/encoder/(vit/blocks\.|transformer/)")
CONVOLUTIONS = re.compile(
    r"/(encoder/(vit|backbone)|depth|dpbu\d)/|/gaussians/(residual/|upsampler/|regressor\d/|head1/)"
)
# Fewer products than this for an output are quicker in float32 than to quantise.
FEW_TERMS = 64
LARGEST_BYTE, LARGEST_WEIGHT, LARGEST_BIAS = 255, 127, 1 << 30
SMALLEST_STEP = 1e-8  # of numbers that are all zero
# Tensors smaller than this stay in the graph's file.
SMALL_TENSOR = 1024  # bytes

Feeds = dict[str, np.ndarray]


def in_precision(precision: str, graph: onnx.ModelProto, weights: Path, examples: Iterable[Feeds]) -> onnx.ModelProto:
    """A float32 graph, whose weights are in a file beside which others may be made, in another precision.

    examples: inputs on which the ranges of what int8 stands for are found. The file of weights is replaced.
    """
    if precision == FLOAT32:
        return graph
    source = weights.with_name("float32.onnx")
    source.write_bytes(graph.SerializeToString())
    made = _in_int8(source, graph, examples) if precision == INT8 else _in_fp16(onnx.load(source))
    _sort(made.graph)
    weights.unlink()
    onnx.save(made, source, save_as_external_data=True, location=weights.name, size_threshold=SMALL_TENSOR)
    return onnx.load(source, load_external_data=False)


def _in_int8(source: Path, graph: onnx.ModelProto, examples: Iterable[Feeds]) -> onnx.ModelProto:
    """The transformers' products quantised as they run, convolutions with ranges found beforehand."""
    dynamic = source.with_name("dynamic.onnx")
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.graph.initializer}
    convolutions = [
        node
        for node in _weighted(graph, "Conv", CONVOLUTIONS, shapes)
        if math.prod(shapes[node.input[1]][1:]) >= FEW_TERMS
    ]
    tensors = {name for node in convolutions for name in (node.input[0], node.output[0])}
    ranges = _ranges(source, graph, sorted(tensors), examples)
    quantize_dynamic(
        source,
        dynamic,
        op_types_to_quantize=["MatMul"],
        nodes_to_quantize=[node.name for node in _weighted(graph, "MatMul", TRANSFORMERS, shapes)],
        weight_type=QuantType.QInt8,
        use_external_data_format=True,
        extra_options={"MatMulConstBOnly": True},
    )
    return _round_convolutions(onnx.load(dynamic), {node.name for node in convolutions}, ranges)


def _ranges(
    source: Path, graph: onnx.ModelProto, tensors: Iterable[str], examples: Iterable[Feeds]
) -> dict[str, tuple[float, float]]:
    """The least and the largest number of each of some tensors on the examples; zero is never outside."""
    watched = onnx.ModelProto()
    watched.CopyFrom(graph)
    del watched.graph.output[:]
    ranges = dict.fromkeys(tensors, (0.0, 0.0))
    for name in ranges:
        for bound in ("ReduceMin", "ReduceMax"):
            watched.graph.node.append(onnx.helper.make_node(bound, [name], [f"{name}.{bound}"], keepdims=0))
            watched.graph.output.append(onnx.ValueInfoProto(name=f"{name}.{bound}"))
    path = source.with_name("watched.onnx")
    path.write_bytes(watched.SerializeToString())
    session = open_session(path)
    for feeds in examples:
        found = run_session(session, feeds)
        for name, (low, high) in ranges.items():
            bounds = float(found[f"{name}.ReduceMin"]), float(found[f"{name}.ReduceMax"])
            ranges[name] = min(low, bounds[0]), max(high, bounds[1])
    return ranges


def _round_convolutions(
    model: onnx.ModelProto, names: set[str], ranges: dict[str, tuple[float, float]]
) -> onnx.ModelProto:
    """Round what convolutions read and yield to int8 and back, which a runtime makes int8 arithmetic of.

    (`quantize_static` of ONNX Runtime writes the same, but searches the whole graph at every step, for minutes.)
    """
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    given_to = {node.input[0] for node in model.graph.node if node.name in names}
    nodes: list[onnx.NodeProto] = []
    rounded: dict[str, str] = {}
    for node in model.graph.node:
        if node.op_type == "Pad" and node.output[0] in given_to:
            # Borders are repeated as integers, a quarter of the bytes.
            padded = node.output[0]
            to_integers, back = _rounding(model.graph, node.input[0], padded, ranges[padded])
            node.input[0], node.output[0] = to_integers.output[0], f"{padded}.padded"
            back.input[0], rounded[padded] = node.output[0], padded
            nodes += [to_integers, node, back]
            continue
        if node.name not in names:
            nodes.append(node)
            continue
        given, result = node.input[0], node.output[0]
        if given not in rounded:
            rounded[given] = f"{given}.rounded"
            nodes += _rounding(model.graph, given, rounded[given], ranges[given])
        kernel, *bias = (onnx.numpy_helper.to_array(weights[name]) for name in node.input[1:])
        channels, step = kernel.reshape(len(kernel), -1), _step(ranges[given])
        steps = np.maximum(np.abs(channels).max(axis=1) / LARGEST_WEIGHT, SMALLEST_STEP)
        for values in bias:  # is in steps of the product
            steps = np.maximum(steps, np.abs(values) / (LARGEST_BIAS * step))
        steps = steps.astype(np.float32)
        integers = [np.rint(channels / steps[:, None]).astype(np.int8).reshape(kernel.shape)]
        integers += [np.rint(values / (steps * step)).astype(np.int32) for values in bias]
        for index, (values, scale) in enumerate(zip(integers, (steps, steps * step), strict=False), 1):
            name = f"{node.name}/{node.input[index]}.rounded"
            nodes.append(_restoring(model.graph, name, values, scale))
            node.input[index] = name
        node.input[0], node.output[0] = rounded[given], f"{result}.exact"
        nodes += [node, *_rounding(model.graph, node.output[0], result, ranges[result])]
        rounded[result] = result
    _replace_nodes(model.graph, nodes)
    return model


def _step(bounds: tuple[float, float]) -> np.float32:
    """The difference between neighbours among the 256 numbers that stand for a range."""
    return np.float32(max((bounds[1] - bounds[0]) / LARGEST_BYTE, SMALLEST_STEP))


def _rounding(
    graph: onnx.GraphProto, given: str, result: str, bounds: tuple[float, float]
) -> tuple[onnx.NodeProto, onnx.NodeProto]:
    """Nodes that take a tensor to int8 and back."""
    zero = np.uint8(np.clip(np.rint(-bounds[0] / _step(bounds)), 0, LARGEST_BYTE))
    scales = [f"{result}.step", f"{result}.zero"]
    for name, value in zip(scales, (_step(bounds), zero), strict=True):
        graph.initializer.append(onnx.numpy_helper.from_array(np.asarray(value), name))
    middle = f"{result}.integers"
    return (
        onnx.helper.make_node("QuantizeLinear", [given, *scales], [middle], name=f"{result}/quantize"),
        onnx.helper.make_node("DequantizeLinear", [middle, *scales], [result], name=f"{result}/dequantize"),
    )


def _restoring(graph: onnx.GraphProto, result: str, values: np.ndarray, steps: np.ndarray) -> onnx.NodeProto:
    """A node that makes weights of integers, with a step for each output channel."""
    parts = {
        f"{result}.integers": values,
        f"{result}.step": steps,
        f"{result}.zero": np.zeros(len(steps), values.dtype),
    }
    for name, value in parts.items():
        graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    return onnx.helper.make_node("DequantizeLinear", list(parts), [result], name=f"{result}/dequantize", axis=0)


def _weighted(
    graph: onnx.ModelProto, operator: str, parts: re.Pattern[str], shapes: dict[str, tuple[int, ...]]
) -> Iterator[onnx.NodeProto]:
    """The nodes in some parts of a network that multiply by trained weights."""
    for node in graph.graph.node:
        if node.op_type == operator and parts.match(node.name) and node.input[1] in shapes:
            yield node


def _in_fp16(model: onnx.ModelProto) -> onnx.ModelProto:
    """Transformers' products and convolutions in fp16, with casts around them, so that all else stays in float32.

    (The converter of onnxruntime.transformers rounds the graph's inputs, and cameras do not bear that.)
    """
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes: list[onnx.NodeProto] = []
    halved: dict[str, str] = {}  # tensors of which there is a copy in fp16
    for node in model.graph.node:
        if not _bears_fp16(node):
            nodes.append(node)
            continue
        for index, name in enumerate(node.input):
            if name not in halved:
                halved[name] = f"{name}.half"
                if name in weights:
                    values = onnx.numpy_helper.to_array(weights[name]).astype(np.float16)
                    model.graph.initializer.append(onnx.numpy_helper.from_array(values, halved[name]))
                else:
                    nodes.append(_cast(node, name, halved[name], onnx.TensorProto.FLOAT16))
            node.input[index] = halved[name]
        result = node.output[0]
        node.output[0] = halved[result] = f"{result}.half"
        nodes += [node, _cast(node, halved[result], result, onnx.TensorProto.FLOAT)]
    _replace_nodes(model.graph, nodes)
    return model


def _replace_nodes(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> None:
    """Give a graph other nodes, without those and the weights whose result nobody reads."""
    read = {name for node in nodes for name in names_read(node)} | {output.name for output in graph.output}
    kept = [weight for weight in graph.initializer if weight.name in read]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(node for node in nodes if read & set(node.output))
    graph.initializer.extend(kept)


def _bears_fp16(node: onnx.NodeProto) -> bool:
    """Whether a node multiplies features."""
    if node.op_type == "MatMul":
        return bool(TRANSFORMERS.match(node.name))
    return node.op_type in ("Conv", "ConvTranspose") and bool(CONVOLUTIONS.match(node.name))


def _cast(node: onnx.NodeProto, given: str, result: str, element: int) -> onnx.NodeProto:
    """A cast before or after a node, in the same part of the network."""
    return onnx.helper.make_node("Cast", [given], [result], name=f"{node.name}/{result}", to=element)


def _sort(graph: onnx.GraphProto) -> None:
    """Put nodes after those whose results they read: the tools above forget what is read inside a Loop."""
    producers = {name: index for index, node in enumerate(graph.node) for name in node.output}
    needed = {
        index: {producers[name] for name in names_read(node) if name in producers}
        for index, node in enumerate(graph.node)
    }
    nodes = [graph.node[index] for index in TopologicalSorter(needed).static_order()]
    del graph.node[:]
    graph.node.extend(nodes)
