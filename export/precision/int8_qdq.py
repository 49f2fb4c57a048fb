"""Conversion to int8 for TensorRT and QNN: operands of convolutions and matrix products are quantised (QDQ).

Both runtimes want what ONNX Runtime's CPU kernels do not: symmetric int8 activations with zero point 0, weights in int8
by output channel, and biases in float32. They fuse the nodes themselves.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from ..graph.subgraph import replace_nodes
from .int8 import MIN_SCALE, Feeds, Ranges, find_ranges

LARGEST = 127
# The axis of a weight's output channels.
CHANNEL_AXES = {"Conv": 0, "ConvTranspose": 1, "MatMul": -1}


def in_int8_qdq(
    source: Path, graph: onnx.ModelProto, quantizable: Iterable[onnx.NodeProto], examples: Iterable[Feeds]
) -> onnx.ModelProto:
    """The graph in the file `source` with int8 operands, as far as nodes are among `quantizable` and have weights.

    graph: the same, loaded. examples: inputs on which the ranges of activations are calibrated.
    """
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.graph.initializer}
    chosen = [node for node in quantizable if node.input[1] in shapes and _has_channels(node)]
    ranges = find_ranges(source, graph, sorted({node.input[0] for node in chosen}), examples)
    return _Quantized(onnx.load(source), {node.name for node in chosen}, ranges).converted()


def _has_channels(node: onnx.NodeProto) -> bool:
    """Whether a weight's output channels lie along one axis: those of a grouped transposed convolution do not."""
    groups = [attribute.i for attribute in node.attribute if attribute.name == "group"]
    return node.op_type != "ConvTranspose" or groups in ([], [1])


class _Quantized:
    """A model whose chosen nodes read quantised and dequantised operands."""

    def __init__(self, model: onnx.ModelProto, names: set[str], ranges: Ranges) -> None:
        self.model, self.names, self.ranges = model, names, ranges
        self.weights = {tensor.name: tensor for tensor in model.graph.initializer}
        self.nodes: list[onnx.NodeProto] = []
        self.made: dict[str, str] = {}  # dequantised operands by the original

    def converted(self) -> onnx.ModelProto:
        """The model, with other nodes and weights."""
        for node in self.model.graph.node:
            if node.name in self.names:
                node.input[0] = self._activation(node.input[0])
                node.input[1] = self._weight(node.input[1], CHANNEL_AXES[node.op_type])
            self.nodes.append(node)
        replace_nodes(self.model.graph, self.nodes)
        return self.model

    def _activation(self, name: str) -> str:
        """The name of an activation after quantisation and dequantisation."""
        if name not in self.made:
            largest = max(map(abs, self.ranges[name]))
            scale = self._constant(f"{name}.scale", np.float32(max(largest / LARGEST, MIN_SCALE)))
            zero = self._constant(f"{name}.zero_point", np.int8(0))
            integers, result = f"{name}.int8", f"{name}.dequantized"
            self._add("QuantizeLinear", [name, scale, zero], integers)
            self._add("DequantizeLinear", [integers, scale, zero], result)
            self.made[name] = result
        return self.made[name]

    def _weight(self, name: str, axis: int) -> str:
        """The name of a weight, dequantised from int8 with a scale for each output channel."""
        if name not in self.made:
            values = onnx.numpy_helper.to_array(self.weights[name])
            axis %= values.ndim
            others = tuple(index for index in range(values.ndim) if index != axis)
            scales = np.maximum(np.abs(values).max(axis=others) / LARGEST, MIN_SCALE).astype(np.float32)
            shaped = np.expand_dims(scales, others)
            given = [
                self._constant(f"{name}.int8", np.rint(values / shaped).astype(np.int8)),
                self._constant(f"{name}.scale", scales),
                self._constant(f"{name}.zero_point", np.zeros(len(scales), np.int8)),
            ]
            self._add("DequantizeLinear", given, f"{name}.dequantized", axis=axis)
            self.made[name] = f"{name}.dequantized"
        return self.made[name]

    def _add(self, operator: str, given: list[str], result: str, **attributes: Any) -> None:
        """Add a node, and name it after its result."""
        self.nodes.append(onnx.helper.make_node(operator, given, [result], name=f"{result}/{operator}", **attributes))

    def _constant(self, name: str, value: np.ndarray | np.generic) -> str:
        """Add a constant."""
        self.model.graph.initializer.append(onnx.numpy_helper.from_array(np.asarray(value), name))
        return name
