"""Shape arithmetic folded and shared: each integer of a shape is a constant, or computed once.

A traced graph computes every shape where it is used, which is a third of its nodes. Here each shape is known as an
expression of the inputs' dimensions (symbolic_shapes.py). A target of Reshape or Expand that copies dimensions, or
leaves one of them open, becomes a constant; all else is computed from the inputs' shapes, once.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import sympy

from . import layer_shape_rules, shape_rules  # noqa: F401  # they register the rules
from .subgraph import remove_unread, sort_nodes
from .symbolic_shapes import Shape, SymbolicShapes, attributes

PREFIX = "shape."  # of the names of what is added
TO_THE_END = np.iinfo(np.int64).max


def fold_shapes(model: onnx.ModelProto, known: SymbolicShapes, inputs: Sequence[str]) -> None:
    """Fold and share the shape arithmetic of a graph in place.

    known: shapes and values of its tensors, to which those of new tensors are added. inputs: the graph's inputs.
    """
    _Folder(model.graph, known, inputs).run()
    remove_unread(model.graph)
    sort_nodes(model.graph)


def declare_shapes(model: onnx.ModelProto, known: SymbolicShapes, names: Mapping[sympy.Symbol, sympy.Expr]) -> None:
    """Write the shape of every tensor that is known into the graph.

    ONNX Runtime reuses the memory of tensors whose shapes it knows to be equal. Where it knows none, its planning takes
    time that is quadratic in the number of nodes: 13 of 15 s of processor time to open a graph of 5,400 nodes with
    version 1.31.

    names: symbols as expressions of the dimensions that the graph's inputs are declared with.
    """
    inferred = onnx.shape_inference.infer_shapes(model)
    elements = {value.name: value.type.tensor_type.elem_type for value in inferred.graph.value_info}
    outputs = {value.name for value in model.graph.output}
    texts: dict[sympy.Expr, int | str] = {}
    del model.graph.value_info[:]
    for name in (name for node in model.graph.node for name in node.output if name not in outputs):
        shape = known.shapes.get(name)
        if shape is None or name not in elements:
            continue
        for dim in shape:
            if dim not in texts:
                texts[dim] = int(dim) if dim.is_Integer else str(sympy.expand(dim.subs(names)))
        model.graph.value_info.append(
            onnx.helper.make_tensor_value_info(name, elements[name], [texts[dim] for dim in shape])
        )


class _Folder:
    """Replaces what nodes read by constants and shared integers."""

    def __init__(self, graph: onnx.GraphProto, known: SymbolicShapes, inputs: Sequence[str]) -> None:
        self.graph, self.known = graph, known
        self.constants = {tensor.name for tensor in graph.initializer}
        self.made: dict[Any, str] = {}  # names of integers that were added, by what they are
        self.scalars: dict[sympy.Expr, str] = {}  # of those, the ones with the value of an expression
        self.replaced: dict[str, str] = {}
        self.producers = {name: node for node in graph.node for name in node.output}
        self.sources = dict(known.sources)
        # In a stage's graph: dimensions that only a tensor of another stage tells.
        inside = {*self.producers, *inputs}
        self.unknown = {symbol for symbol, (name, _) in known.sources.items() if name not in inside}
        # A symbol is an input's dimension divided by a number.
        self.divisors: dict[sympy.Symbol, int] = {}
        for name in inputs:
            for axis, dim in enumerate(known.shapes.get(name) or ()):
                symbols = dim.free_symbols
                if len(symbols) == 1 and (symbol := symbols.pop()) not in self.sources and (dim / symbol).is_Integer:
                    self.sources[symbol], self.divisors[symbol] = (name, axis), int(dim / symbol)

    def run(self) -> None:
        """Rewrite every node of the graph."""
        outputs = {value.name for value in self.graph.output}
        for node in list(self.graph.node):
            for index, name in enumerate(node.input):
                node.input[index] = self.replaced.get(name, name)
            self._rewrite(node)
            if self._does_nothing(node) and node.output[0] not in outputs:
                self.replaced[node.output[0]] = node.input[0]
            for index, name in enumerate(node.input):
                value = self.known.values.get(name)
                if value is not None and name not in self.constants and self._is_derivable(value.flat):
                    node.input[index] = self._integers(value)

    def _rewrite(self, node: onnx.NodeProto) -> None:
        """Give a node constants in place of a shape, where it has an equivalent."""
        target = self.known.shapes.get(node.output[0])
        if target is None or not self._is_derivable(target):
            return
        if node.op_type in ("Reshape", "Flatten", "Squeeze", "Unsqueeze"):
            self._reshape(node, target)
        elif node.op_type == "Expand":
            self._expand(node, target)
        elif node.op_type == "Slice":
            self._slice(node)
        elif node.op_type == "Resize":
            self._resize(node, target)

    def _reshape(self, node: onnx.NodeProto, target: Shape) -> None:
        """Copy dimensions (0), leave one open (-1), and write the others; skip a Reshape before."""
        before = self.producers.get(node.input[0])
        source = before.input[0] if before is not None and before.op_type in RESHAPING else node.input[0]
        own = [axis for axis, dim in enumerate(target) if self._is_read_from(dim, node.output[0])]
        if len(own) > 1:
            return
        dims = self._target(self.known.shapes.get(source), target, own)
        computed = any(not dim.is_Integer for dim in dims)
        if node.op_type in ("Squeeze", "Unsqueeze") and (source == node.input[0] or computed):
            return
        del node.attribute[:]
        node.op_type = "Reshape"
        node.input[:] = [source, self._integers(_array(dims))]

    def _is_derivable(self, dims: Iterable[sympy.Expr]) -> bool:
        """Whether dimensions can be computed from tensors of this graph."""
        return not any(dim.free_symbols & self.unknown for dim in dims)

    def _is_read_from(self, dim: sympy.Expr, name: str) -> bool:
        """Whether a dimension is known only from a tensor that has it."""
        return any(self.sources[symbol][0] == name for symbol in dim.free_symbols if symbol in self.sources)

    @staticmethod
    def _target(shape: Shape | None, target: Shape, left_open: list[int]) -> list[sympy.Expr]:
        """The second input of a Reshape from one shape to another. left_open: an axis that only the result tells."""
        dims: list[sympy.Expr] = []
        for axis, dim in enumerate(target):
            copied = shape is not None and axis < len(shape) and dim == shape[axis] and not dim.is_Integer
            dims.append(sympy.Integer(0) if copied else dim)
        symbolic = [axis for axis, dim in enumerate(dims) if not dim.is_Integer]
        if symbolic:
            dims[(left_open or symbolic)[0]] = sympy.Integer(-1)
        return dims

    def _expand(self, node: onnx.NodeProto, target: Shape) -> None:
        """Write 1 for the dimensions that stay as they are."""
        shape = self.known.shapes.get(node.input[0])
        if shape is None:
            return
        padded = (sympy.Integer(1),) * (len(target) - len(shape)) + shape
        dims = [sympy.Integer(1) if old == new else new for old, new in zip(padded, target, strict=True)]
        if len(shape) == len(target):
            while len(dims) > 1 and dims[0] == 1:
                del dims[0]
        node.input[1] = self._integers(_array(dims))

    def _slice(self, node: onnx.NodeProto) -> None:
        """Write an end that is the dimension's as the largest integer."""
        shape, ends = self.known.shapes.get(node.input[0]), self.known.value(node, 2)
        if shape is None or ends is None:
            return
        axes = self.known.numbers(node, 3) or list(range(len(ends)))
        steps = self.known.numbers(node, 4) or [1] * len(axes)
        if self._select_top(node, shape, axes, steps):
            return
        bounds = [
            sympy.Integer(TO_THE_END) if step > 0 and end == shape[axis] else end
            for axis, end, step in zip(axes, ends, steps, strict=True)
        ]
        node.input[2] = self._integers(_array(bounds))

    def _select_top(self, node: onnx.NodeProto, shape: Shape, axes: list[int], steps: list[int]) -> bool:
        """Have a TopK find only what a Slice takes from the start of its indices; whether that is what it does."""
        top = self.producers.get(node.input[0])
        starts, target = self.known.numbers(node, 1), self.known.shapes[node.output[0]]
        if top is None or top.op_type != "TopK" or node.input[0] != top.output[1] or target is None:
            return False
        last = len(shape) - 1
        from_start = starts == [0] and steps == [1] and [axis % len(shape) for axis in axes] == [last]
        if not from_start or attributes(top).get("axis", -1) % len(shape) != last:
            return False
        if sum(name in node.input for node in self.graph.node for name in top.output) > 1:
            return False
        top.input[1] = self._integers(_array([target[-1]]))
        for name in top.output:
            self.known.shapes[name] = target
        return True

    def _resize(self, node: onnx.NodeProto, target: Shape) -> None:
        """Write sizes that are whole multiples as scales."""
        shape = self.known.shapes.get(node.input[0])
        if shape is None or len(node.input) < 4 or all(dim.is_Integer for dim in target):
            return
        scales = [new / old for old, new in zip(shape, target, strict=True)]
        if all(scale.is_Integer for scale in scales):
            values = np.array([int(scale) for scale in scales], np.float32)
            node.input[:] = [node.input[0], "", self._constant("scales", values)]

    def _does_nothing(self, node: onnx.NodeProto) -> bool:
        """Whether a node only passes its first input on."""
        if node.op_type not in ("Reshape", "Expand", "Slice", "Identity", "Transpose", "Tile"):
            return False
        shape, result = self.known.shapes.get(node.input[0]), self.known.shapes.get(node.output[0])
        if shape is None or shape != result:
            return node.op_type == "Identity"
        if node.op_type == "Transpose":
            order = attributes(node).get("perm")
            return order is not None and list(order) == sorted(order)
        return node.op_type != "Slice" or (self.known.numbers(node, 4) or [1])[0] > 0

    def _integers(self, value: np.ndarray) -> str:
        """The name of a tensor with this value: a constant, or computed."""
        if all(entry.is_Integer for entry in value.flat):
            numbers = np.array([min(int(entry), TO_THE_END) for entry in value.flat], np.int64).reshape(value.shape)
            return self._constant("constant", numbers)
        if value.ndim == 0:
            return self._node("Squeeze", [self._scalar(value.item())])
        parts = [self._scalar(entry) for entry in value.flat]
        whole = parts[0] if len(parts) == 1 else self._node("Concat", parts, axis=0)
        if value.ndim == 1:
            return whole
        return self._node("Reshape", [whole, self._constant("constant", np.array(value.shape, np.int64))])

    def _scalar(self, expression: sympy.Expr) -> str:
        """The name of a tensor [1] with the value of an expression."""
        if expression not in self.scalars:
            self.scalars[expression] = self._compute(expression)
        return self.scalars[expression]

    def _compute(self, expression: sympy.Expr) -> str:
        """Add what computes an expression, from the inputs' shapes; the name of the result."""
        if expression.is_Integer:
            return self._constant("constant", np.array([int(expression)], np.int64))
        if expression.is_Symbol:
            name, axis = self.sources[expression]
            dim = self._node("Shape", [name], start=axis, end=axis + 1)
            divisor = self.divisors.get(expression, 1)
            return dim if divisor == 1 else self._node("Div", [dim, self._scalar(sympy.Integer(divisor))])
        for symbol, divisor in self.divisors.items():  # the input's own dimension, or a part of it
            if divisor > 1 and (factor := expression / symbol).is_Integer and divisor % int(factor) == 0:
                name, axis = self.sources[symbol]
                dim = self._node("Shape", [name], start=axis, end=axis + 1)
                rest = sympy.Integer(divisor // int(factor))
                return dim if rest == 1 else self._node("Div", [dim, self._scalar(rest)])
        inner = expression.args[0] if isinstance(expression, sympy.floor) else expression
        over, under = sympy.fraction(sympy.together(inner))
        if under != 1:
            return self._node("Div", [self._scalar(sympy.expand(over)), self._scalar(under)])
        operator, parts = OPERATORS[expression.func], list(expression.args)
        if expression.is_Pow:
            parts = [expression.base] * int(expression.exp)
        first, *rest = sorted(parts, key=lambda part: (part.is_number, str(part)))
        result = self._scalar(first)
        for argument in rest:
            result = self._node(operator, [result, self._scalar(argument)])
        return result

    def _constant(self, kind: str, value: np.ndarray) -> str:
        """The name of an initialiser with this value."""
        key = kind, value.dtype.str, value.shape, value.tobytes()
        if key not in self.made:
            name = f"{PREFIX}{kind}.{len(self.made)}"
            self.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
            self.known.shapes[name] = tuple(map(sympy.Integer, value.shape))
            self.constants.add(name)
            self.made[key] = name
        return self.made[key]

    def _node(self, operator: str, inputs: list[str], **given: Any) -> str:
        """The name of the output of a node, which is added unless it is there."""
        key = operator, tuple(inputs), tuple(given.items())
        if key not in self.made:
            name = f"{PREFIX}{operator}.{len(self.made)}"
            self.graph.node.append(onnx.helper.make_node(operator, inputs, [name], name=name, **given))
            self.made[key] = name
        return self.made[key]


RESHAPING = ("Reshape", "Flatten", "Squeeze", "Unsqueeze")
OPERATORS = {sympy.Add: "Add", sympy.Mul: "Mul", sympy.Pow: "Mul", sympy.Min: "Min", sympy.Max: "Max"}


def _array(dims: Sequence[sympy.Expr]) -> np.ndarray:
    value = np.empty(len(dims), object)
    value[:] = dims
    return value
