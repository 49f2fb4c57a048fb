"""Symbolic shape inference: the shape of every tensor, and the value of every small integer tensor, as expressions.

Dimensions are sympy expressions in positive integers. What a rule does not cover stays unknown (None); nothing is
guessed but that two maps which a node combines have the same size.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
import sympy

Shape = tuple[sympy.Expr, ...]
# Integer tensors with more values than this are data, not shapes.
MAX_VALUES = 64
# The end of a slice that stands for "to the end".
LARGE = 1 << 30
SCALES = (3, 4, 5)  # lengths of a Resize's
UNKNOWN: tuple[None, None] = (None, None)


@dataclass
class SymbolicShapes:
    """Shapes and integer values by tensor name.

    sources: for dimensions that no rule computes, the tensor and axis that have them, by their symbol.
    """

    shapes: dict[str, Shape | None] = field(default_factory=dict)
    values: dict[str, np.ndarray | None] = field(default_factory=dict)
    sources: dict[sympy.Symbol, tuple[str, int]] = field(default_factory=dict)
    # Short float constants, such as a Resize reads.
    scales: dict[str, list[float]] = field(default_factory=dict)

    def infer(self, graph: onnx.GraphProto, inputs: Mapping[str, Iterable[Any]]) -> None:
        """Infer a graph in topological order from the shapes of its inputs."""
        for name, shape in inputs.items():
            self.shapes[name] = tuple(map(sympy.sympify, shape))
        for tensor in graph.initializer:
            self._constant(tensor.name, tensor)
        for node in graph.node:
            self.infer_node(node)

    def copy(self) -> "SymbolicShapes":
        """The same, to be changed by itself."""
        return SymbolicShapes(dict(self.shapes), dict(self.values), dict(self.sources), dict(self.scales))

    def infer_node(self, node: onnx.NodeProto) -> None:
        """Add the outputs of a node whose inputs are known."""
        rule = RULES.get(node.op_type)
        results = rule(self, node) if rule else []
        for index, name in enumerate(node.output):
            shape, value = results[index] if index < len(results) else UNKNOWN
            if value is not None and value.size > MAX_VALUES:
                value = None
            self.shapes[name] = shape if value is None else tuple(map(sympy.Integer, value.shape))
            self.values[name] = value

    def _constant(self, name: str, tensor: onnx.TensorProto) -> None:
        self.shapes[name] = tuple(map(sympy.Integer, tensor.dims))
        integer = tensor.data_type == onnx.TensorProto.INT64
        if integer and tensor.data_location != onnx.TensorProto.EXTERNAL and math.prod(tensor.dims) <= MAX_VALUES:
            self.values[name] = as_expressions(onnx.numpy_helper.to_array(tensor))
        elif tensor.data_type == onnx.TensorProto.FLOAT and len(tensor.dims) == 1 and tensor.dims[0] in SCALES:
            self.scales[name] = onnx.numpy_helper.to_array(tensor).tolist()

    def shape(self, node: onnx.NodeProto, index: int = 0) -> Shape | None:
        """The shape of an input."""
        return self.shapes.get(node.input[index])

    def value(self, node: onnx.NodeProto, index: int) -> np.ndarray | None:
        """The value of an integer input; None if it is unknown or left out."""
        return self.values.get(node.input[index]) if index < len(node.input) and node.input[index] else None

    def numbers(self, node: onnx.NodeProto, index: int, attribute: str = "") -> list[int] | None:
        """The value of an input, or of an attribute, if it is constant."""
        value = self.value(node, index)
        if value is not None:
            return [int(entry) for entry in value.flat] if all(entry.is_Integer for entry in value.flat) else None
        return attributes(node).get(attribute) if attribute else None

    def dimension(self, node: onnx.NodeProto, axis: int) -> sympy.Symbol:
        """A new symbol for a dimension of a node's output that no rule computes."""
        symbol = sympy.Symbol(f"{node.output[0]}:{axis}", integer=True, positive=True)
        self.sources[symbol] = node.output[0], axis
        return symbol


def attributes(node: onnx.NodeProto) -> dict[str, Any]:
    """A node's attributes by name."""
    return {attribute.name: onnx.helper.get_attribute_value(attribute) for attribute in node.attribute}


def as_expressions(values: np.ndarray) -> np.ndarray:
    """Integers as sympy's, in an array of objects of the same shape."""
    result = np.empty(values.shape, object)
    for index in np.ndindex(values.shape):
        result[index] = sympy.Integer(int(values[index]))
    return result


def product(dims: Iterable[sympy.Expr]) -> sympy.Expr:
    """The product of dimensions, multiplied out."""
    return sympy.expand(sympy.Mul(*dims))


def quotient(a: sympy.Expr, b: sympy.Expr) -> sympy.Expr:
    """An exact quotient."""
    result = a / b
    return result if result.is_Integer or not (a.is_Add or b.is_Add) else sympy.cancel(result)


def floor_divide(a: sympy.Expr, b: sympy.Expr) -> sympy.Expr:
    """The integer quotient of positive expressions."""
    return sympy.floor(sympy.expand(a / b))


def broadcast(shapes: Sequence[Shape | None]) -> Shape | None:
    """The shape of an elementwise result."""
    if any(shape is None for shape in shapes):
        return None
    known = [shape for shape in shapes if shape is not None]
    rank = max(map(len, known), default=0)
    dims = []
    for axis in range(-rank, 0):
        sizes = [shape[axis] for shape in known if len(shape) >= -axis and shape[axis] != 1]
        numbers = [size for size in sizes if size.is_Integer]
        dims.append((numbers or sizes or [sympy.Integer(1)])[0])
    return tuple(dims)


Result = list[tuple[Shape | None, np.ndarray | None]]
Rule = Callable[[SymbolicShapes, onnx.NodeProto], Result]
RULES: dict[str, Rule] = {}


def rule(*operators: str) -> Callable[[Rule], Rule]:
    """Register a rule for operators."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(operators, function))
        return function

    return register
