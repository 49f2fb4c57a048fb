"""Conversion to int8: MatMuls with dynamic quantisation, convolutions with static quantisation by calibrated ranges."""

import logging
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnxruntime.quantization import QuantType, quantize_dynamic

from ...runtime.inference.session import open_session, run_session
from ..graph.subgraph import names_read, replace_nodes

# A convolution with fewer multiplications than this for an output value is faster in float32.
FEW_TERMS = 64
LARGEST_BYTE, LARGEST_WEIGHT, LARGEST_BIAS = 255, 127, 1 << 30
MIN_SCALE = 1e-8  # for tensors that are all zero
# ONNX Runtime convolves two to four times as fast where channels, in and out, are multiples of this.
LANES = 4
# Operators that only move or repeat values, those of their first input (Concat: of all inputs).
MOVING = ("Concat", "Pad")

Feeds = Mapping[str, np.ndarray]
Ranges = dict[str, tuple[float, float]]


def in_int8(
    source: Path, graph: onnx.ModelProto, quantizable: Iterable[onnx.NodeProto], examples: Iterable[Feeds]
) -> onnx.ModelProto:
    """The graph in the file `source` in int8, as far as nodes are among `quantizable` and have trained weights.

    graph: the same, loaded. examples: inputs on which the ranges of activations are calibrated.
    """
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.graph.initializer}
    weighted = [node for node in quantizable if node.input[1] in shapes]
    convolutions = [
        node for node in weighted if node.op_type == "Conv" and math.prod(shapes[node.input[1]][1:]) >= FEW_TERMS
    ]
    tensors = {name for node in convolutions for name in (node.input[0], node.output[0])}
    ranges = find_ranges(source, graph, sorted(tensors), examples)
    dynamic = source.with_name("dynamic.onnx")
    logging.disable(logging.WARNING)  # it advises to prepare the graph, which `simplify` has done
    try:
        quantize_dynamic(
            source,
            dynamic,
            op_types_to_quantize=["MatMul"],
            nodes_to_quantize=[node.name for node in weighted if node.op_type == "MatMul"],
            weight_type=QuantType.QInt8,
            use_external_data_format=True,
            extra_options={"MatMulConstBOnly": True},
        )
    finally:
        logging.disable(logging.NOTSET)
    return _Convolutions(onnx.load(dynamic), {node.name for node in convolutions}, ranges).converted()


def find_ranges(source: Path, graph: onnx.ModelProto, tensors: Iterable[str], examples: Iterable[Feeds]) -> Ranges:
    """The smallest and the largest value of each tensor on the examples; the range always contains zero."""
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
        found = run_session(session, dict(feeds))
        for name, (low, high) in ranges.items():
            bounds = float(found[f"{name}.ReduceMin"]), float(found[f"{name}.ReduceMax"])
            ranges[name] = min(low, bounds[0]), max(high, bounds[1])
    return ranges


class _Convolutions:
    """Quantises and dequantises inputs and outputs of convolutions (QDQ), which runtimes fuse to int8 convolutions.

    Tensors that only convolutions read are quantised before Concat and Pad: integers are a quarter of the bytes.
    (`quantize_static` of ONNX Runtime writes the same but for that, and takes minutes, since it searches the whole
    graph at every step.)
    """

    def __init__(self, model: onnx.ModelProto, names: set[str], ranges: Ranges) -> None:
        self.model, self.names, self.ranges = model, names, ranges
        self.weights = {tensor.name: tensor for tensor in model.graph.initializer}
        self.nodes: list[onnx.NodeProto] = []
        # By tensor and the tensor whose range it is quantised to: the quantised and the dequantised version.
        self.quantized: dict[tuple[str, str], str] = {}
        self.dequantized: dict[tuple[str, str], str] = {}
        self.scales: dict[str, list[str]] = {}

    def converted(self) -> onnx.ModelProto:
        """The model, with other nodes and weights."""
        moved = self._moved()
        for node in self.model.graph.node:
            if node.name in self.names:
                self._convolution(node)
            elif node.output[0] in moved:
                self._move(node, moved[node.output[0]])
            else:
                self.nodes.append(node)
        replace_nodes(self.model.graph, self.nodes)
        return self.model

    def _moved(self) -> dict[str, str]:
        """Outputs of `MOVING` nodes to quantise early, each with the convolution input whose range it has."""
        readers: dict[str, list[onnx.NodeProto]] = {}
        for node in self.model.graph.node:
            for name in names_read(node):
                readers.setdefault(name, []).append(node)
        outputs = {output.name for output in self.model.graph.output}
        moved: dict[str, str] = {}
        for node in reversed(self.model.graph.node):
            result = node.output[0]
            if node.op_type in MOVING and result not in outputs:
                becomes = {
                    result if reader.name in self.names else moved.get(reader.output[0])
                    for reader in readers.get(result, ())
                }
                if len(becomes) == 1 and (whose := becomes.pop()) is not None:
                    moved[result] = whose
        return moved

    def _move(self, node: onnx.NodeProto, whose: str) -> None:
        """Have a Concat or Pad move quantised values."""
        result = node.output[0]
        for index in range(len(node.input) if node.op_type == "Concat" else 1):
            node.input[index] = self._quantized(node.input[index], whose)
        node.output[0] = self.quantized[result, whose] = f"{result}.integers"
        self.nodes.append(node)

    def _convolution(self, node: onnx.NodeProto) -> None:
        """Quantise a convolution's input, weights and output."""
        given, result = node.input[0], node.output[0]
        kernel, *bias = (onnx.numpy_helper.to_array(self.weights[name]) for name in node.input[1:])
        outputs, inputs = kernel.shape[:2]
        more_outputs = -outputs % LANES
        more_inputs = 0 if kernel[0].size % LANES == 0 else -inputs % LANES
        kernel = np.pad(kernel, [(0, more_outputs), (0, more_inputs), *[(0, 0)] * (kernel.ndim - 2)])
        bias = [np.pad(values, (0, more_outputs)) for values in bias]
        read = self._pad_channels(given, more_inputs, kernel.ndim) if more_inputs else given
        node.input[0] = self._dequantized(read, given)
        node.input[1:] = self._rounded_weights(node, [kernel, *bias], _step(self.ranges[given]))
        node.output[0] = f"{result}.exact"
        self.nodes.append(node)
        integers = self._quantize(node.output[0], result)
        if more_outputs:
            integers = self._slice_channels(integers, outputs)
        self.quantized[result, result] = integers
        self.dequantized[result, result] = self._dequantize(integers, result, result)

    def _rounded_weights(self, node: onnx.NodeProto, weights: list[np.ndarray], step: np.float32) -> list[str]:
        """Names of the quantised kernel and bias of a convolution; step: the input's scale."""
        kernel, *bias = weights
        channels = kernel.reshape(len(kernel), -1)
        steps = np.maximum(np.abs(channels).max(axis=1) / LARGEST_WEIGHT, MIN_SCALE)
        for values in bias:  # its scale is the product of the kernel's and the input's
            steps = np.maximum(steps, np.abs(values) / (LARGEST_BIAS * step))
        steps = steps.astype(np.float32)
        integers = [np.rint(channels / steps[:, None]).astype(np.int8).reshape(kernel.shape)]
        integers += [np.rint(values / (steps * step)).astype(np.int32) for values in bias]
        results = []
        for name, values, scale in zip(node.input[1:], integers, (steps, steps * step), strict=False):
            result = f"{node.name}/{name}.rounded"
            parts = {"integers": values, "step": scale, "zero": np.zeros(len(scale), values.dtype)}
            given = [self._constant(f"{result}.{part}", value) for part, value in parts.items()]
            self._add("DequantizeLinear", given, result, axis=0)
            results.append(result)
        return results

    def _pad_channels(self, name: str, channels: int, axes: int) -> str:
        """The name of a tensor with that many more channels, of zeros, in the same range."""
        wide = f"{name}.wide"
        if (wide, name) not in self.quantized:
            # ONNX Runtime's optimiser fails on a Pad with axes, so the pads of all axes are given.
            pads = np.zeros((2, axes), np.int64)
            pads[1, 1] = channels
            given = [self._quantized(name, name), self._constant(f"{wide}.pads", pads.ravel()), self._scale(name)[1]]
            self.quantized[wide, name] = self._add("Pad", given, f"{wide}.integers")
        return wide

    def _slice_channels(self, name: str, channels: int) -> str:
        """The first channels of a tensor."""
        bounds = {"starts": 0, "ends": channels, "axes": 1}
        given = [self._constant(f"{name}.{bound}", np.array([value], np.int64)) for bound, value in bounds.items()]
        return self._add("Slice", [name, *given], f"{name}.narrow")

    def _quantized(self, name: str, whose: str) -> str:
        """The quantised version of a tensor, in the range of the tensor `whose`."""
        if (name, whose) not in self.quantized:
            self.quantized[name, whose] = self._quantize(name, whose)
        return self.quantized[name, whose]

    def _dequantized(self, name: str, whose: str) -> str:
        """The dequantised float32 version of a quantised tensor."""
        if (name, whose) not in self.dequantized:
            self.dequantized[name, whose] = self._dequantize(self._quantized(name, whose), whose, f"{name}.rounded")
        return self.dequantized[name, whose]

    def _quantize(self, name: str, whose: str) -> str:
        """Add a QuantizeLinear with the range of the tensor `whose`."""
        return self._add("QuantizeLinear", [name, *self._scale(whose)], f"{name}.integers.{whose}")

    def _dequantize(self, name: str, whose: str, result: str) -> str:
        """Add a DequantizeLinear with the range of the tensor `whose`."""
        return self._add("DequantizeLinear", [name, *self._scale(whose)], result)

    def _add(self, operator: str, given: list[str], result: str, **attributes: Any) -> str:
        """Add a node, and name it after its result."""
        self.nodes.append(onnx.helper.make_node(operator, given, [result], name=f"{result}/{operator}", **attributes))
        return result

    def _scale(self, whose: str) -> list[str]:
        """Constants for the scale and the zero point of a tensor's range."""
        if whose not in self.scales:
            step = _step(self.ranges[whose])
            zero = np.uint8(np.clip(np.rint(-self.ranges[whose][0] / step), 0, LARGEST_BYTE))
            self.scales[whose] = [self._constant(f"{whose}.step", step), self._constant(f"{whose}.zero", zero)]
        return self.scales[whose]

    def _constant(self, name: str, value: np.ndarray | np.generic) -> str:
        """Add a constant."""
        self.model.graph.initializer.append(onnx.numpy_helper.from_array(np.asarray(value), name))
        return name


def _step(bounds: tuple[float, float]) -> np.float32:
    """The scale of a range: its width over 255."""
    return np.float32(max((bounds[1] - bounds[0]) / LARGEST_BYTE, MIN_SCALE))
