"""Symbolic shape inference of operators that compute elementwise, and that move values."""

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import sympy

from .symbolic_shapes import (
    LARGE,
    UNKNOWN,
    Result,
    SymbolicShapes,
    as_expressions,
    attributes,
    broadcast,
    floor_divide,
    product,
    quotient,
    rule,
)

INT64 = onnx.TensorProto.INT64
ONE = sympy.Integer(1)


@rule(
    *("Sigmoid", "Gelu", "Relu", "Softmax", "Exp", "Clip", "Neg", "Abs", "Floor", "Round", "Cos", "Sin", "Softplus"),
    *("Reciprocal", "Not", "LayerNormalization", "InstanceNormalization", "BatchNormalization", "Sqrt", "Erf", "Tanh"),
    *("QuantizeLinear", "DequantizeLinear", "Identity", "IsNaN", "HardSigmoid", "Sign"),
)
def _same(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    value = known.value(node, 0) if node.op_type == "Identity" else None
    return [(known.shape(node), value)]


@rule("DynamicQuantizeLinear")
def _quantize(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    """The integers, and their scale and zero point."""
    return [(known.shape(node), None), ((), None), ((), None)]


@rule("Cast")
def _cast(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    return [(known.shape(node), known.value(node, 0) if attributes(node)["to"] == INT64 else None)]


ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "Add": lambda a, b: sympy.expand(a + b),
    "Sub": lambda a, b: sympy.expand(a - b),
    "Mul": lambda a, b: sympy.expand(a * b),
    "Div": lambda a, b: floor_divide(a, b),
    "Min": lambda a, b: sympy.Min(a, b),
    "Max": lambda a, b: sympy.Max(a, b),
}


@rule("Add", "Sub", "Mul", "Div", "Min", "Max", "Pow", "Mod", "And", "Or", "Greater", "Less")
@rule("LessOrEqual", "GreaterOrEqual")
def _elementwise(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape = broadcast([known.shape(node, index) for index in range(len(node.input))])
    values = [known.value(node, index) for index in range(len(node.input))]
    if node.op_type not in ARITHMETIC or len(values) != 2 or values[0] is None or values[1] is None:
        return [(shape, None)]
    return [(shape, np.vectorize(ARITHMETIC[node.op_type], otypes=[object])(*values))]


@rule("Equal")
def _equal(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape = broadcast([known.shape(node, 0), known.shape(node, 1)])
    left, right = known.value(node, 0), known.value(node, 1)
    if left is None or right is None:
        return [(shape, None)]
    left, right = np.broadcast_arrays(left, right)
    result = np.empty(left.shape, object)
    for index in np.ndindex(left.shape):
        difference = sympy.expand(left[index] - right[index])
        if difference.is_zero is None:
            return [(shape, None)]
        result[index] = sympy.Integer(int(difference.is_zero))
    return [(shape, result)]


@rule("Where")
def _where(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape = broadcast([known.shape(node, index) for index in range(3)])
    condition, yes, no = (known.value(node, index) for index in range(3))
    if condition is None or yes is None or no is None:
        return [(shape, None)]
    return [(shape, np.where(condition != 0, yes, no))]


@rule("Shape")
def _shape(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape = known.shape(node)
    if shape is None:
        return [UNKNOWN]
    given = attributes(node)
    dims = shape[given.get("start", 0) : given.get("end", len(shape))]
    value = np.empty(len(dims), object)
    value[:] = dims
    return [(None, value)]


@rule("Constant")
def _constant(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    ((name, given),) = attributes(node).items()
    array = onnx.numpy_helper.to_array(given) if name == "value" else np.asarray(given)
    value = as_expressions(array) if array.dtype == np.int64 else None
    return [(tuple(map(sympy.Integer, array.shape)), value)]


@rule("ConstantOfShape")
def _constant_of_shape(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    dims = known.value(node, 0)
    if dims is None:
        return [UNKNOWN]
    value = None
    tensor = attributes(node).get("value")
    if tensor is not None and tensor.data_type == INT64 and all(dim.is_Integer for dim in dims):
        value = as_expressions(np.full([int(dim) for dim in dims], onnx.numpy_helper.to_array(tensor).item()))
    return [(tuple(dims), value)]


@rule("Reshape")
def _reshape(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, target, value = known.shape(node), known.value(node, 1), known.value(node, 0)
    if target is None:
        return [UNKNOWN]
    keeps_zero = attributes(node).get("allowzero", 0)
    dims = []
    for axis, dim in enumerate(target):
        if dim == 0 and not keeps_zero:
            if shape is None:
                return [UNKNOWN]
            dim = shape[axis]
        dims.append(dim)
    if -1 in dims:
        axis = dims.index(-1)
        if shape is None:
            dims[axis] = known.dimension(node, axis)
        else:
            dims[axis] = quotient(product(shape), product(dims[:axis] + dims[axis + 1 :]))
    if value is not None:
        value = value.reshape([int(dim) for dim in dims])
    return [(tuple(dims), value)]


@rule("Flatten")
def _flatten(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, axis = known.shape(node), attributes(node).get("axis", 1)
    return [((product(shape[:axis]), product(shape[axis:])), None)] if shape is not None else [UNKNOWN]


@rule("Squeeze")
def _squeeze(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, value = known.shape(node), known.value(node, 0)
    if shape is None:
        return [UNKNOWN]
    axes = known.numbers(node, 1, "axes")
    gone = {axis % len(shape) for axis in axes} if axes else {axis for axis, dim in enumerate(shape) if dim == 1}
    left = tuple(dim for axis, dim in enumerate(shape) if axis not in gone)
    return [(left, None if value is None else value.reshape([int(dim) for dim in left]))]


@rule("Unsqueeze")
def _unsqueeze(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, value, axes = known.shape(node), known.value(node, 0), known.numbers(node, 1, "axes")
    if shape is None or axes is None:
        return [UNKNOWN]
    dims = list(shape)
    rank = len(shape) + len(axes)
    for axis in sorted(axis % rank for axis in axes):
        dims.insert(axis, ONE)
    return [(tuple(dims), None if value is None else value.reshape([int(dim) for dim in dims]))]


@rule("Concat")
def _concat(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    axis = attributes(node)["axis"]
    values = [known.value(node, index) for index in range(len(node.input))]
    parts = [value for value in values if value is not None]
    if len(parts) == len(values) and all(part.ndim == 1 for part in parts):
        return [(None, np.concatenate(parts))]
    shapes = [known.shape(node, index) for index in range(len(node.input))]
    whole = [shape for shape in shapes if shape is not None]
    if len(whole) < len(shapes):
        return [UNKNOWN]
    dims = list(whole[0])
    dims[axis] = sympy.expand(sympy.Add(*(shape[axis] for shape in whole)))
    return [(tuple(dims), None)]


@rule("Slice")
def _slice(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, value = known.shape(node), known.value(node, 0)
    starts, ends = known.value(node, 1), known.value(node, 2)
    if shape is None:
        return [UNKNOWN]
    count = len(starts) if starts is not None else len(shape)
    axes = known.numbers(node, 3) or list(range(count))
    steps = known.numbers(node, 4) or [1] * len(axes)
    dims = list(shape)
    for index, axis in enumerate(axes):
        start = starts[index] if starts is not None else None
        end = ends[index] if ends is not None else None
        length = sliced_length(dims[axis], start, end, steps[index])
        dims[axis] = known.dimension(node, axis % len(dims)) if length is None else length
    first, last = known.numbers(node, 1), known.numbers(node, 2)
    if value is None or first is None or last is None:
        return [(tuple(dims), None)]
    parts = [slice(None)] * value.ndim
    for axis, start, end, step in zip(axes, first, last, steps, strict=True):
        parts[axis] = slice(start, None if end < -LARGE else end, step)
    return [(None, value[tuple(parts)])]


def sliced_length(dim: sympy.Expr, start: Any, end: Any, step: int) -> sympy.Expr | None:
    """The length of a slice of a dimension; None where it depends on what is not known."""
    if start is None or end is None:
        return None
    if step == -1:
        return dim if start == -1 and end.is_Integer and end < -LARGE else None
    if step != 1:
        return None
    bounds = []
    for bound in (start, end):
        if bound.is_Integer and bound >= LARGE:
            bound = dim
        elif bound.is_negative:
            bound = sympy.expand(dim + bound)
        elif not bound.is_nonnegative:
            return None
        beyond = sympy.expand(bound - dim)
        if beyond.is_positive:
            bound = dim
        elif not beyond.is_nonpositive:
            bound = sympy.Min(bound, dim)
        bounds.append(bound)
    return sympy.expand(bounds[1] - bounds[0])


@rule("Gather")
def _gather(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, where = known.shape(node), known.shape(node, 1)
    value, index = known.value(node, 0), known.value(node, 1)
    if value is not None and index is not None and value.ndim == 1 and all(entry.is_Integer for entry in index.flat):
        return [(None, np.asarray(value[index.astype(np.int64)], object))]
    if shape is None or where is None:
        return [UNKNOWN]
    axis = attributes(node).get("axis", 0) % len(shape)
    return [(shape[:axis] + where + shape[axis + 1 :], None)]


@rule("GatherElements")
def _gather_elements(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    return [(known.shape(node, 1), None)]


@rule("Transpose")
def _transpose(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape = known.shape(node)
    if shape is None:
        return [UNKNOWN]
    value, order = known.value(node, 0), attributes(node).get("perm", range(len(shape))[::-1])
    return [(tuple(shape[axis] for axis in order), None if value is None else value.transpose(order))]


@rule("Split")
def _split(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, sizes, given = known.shape(node), known.numbers(node, 1), attributes(node)
    if shape is None:
        return [UNKNOWN] * len(node.output)
    axis = given.get("axis", 0) % len(shape)
    if sizes is None:
        parts = [quotient(shape[axis], sympy.Integer(len(node.output)))] * len(node.output)
    else:
        parts = [sympy.Integer(size) for size in sizes]
    return [((*shape[:axis], part, *shape[axis + 1 :]), None) for part in parts]


@rule("Expand")
def _expand(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    target = known.value(node, 1)
    return [(broadcast([known.shape(node), tuple(target)]), None)] if target is not None else [UNKNOWN]


@rule("Range")
def _range(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    start, end, step = (known.value(node, index) for index in range(3))
    if start is None or end is None or step is None or step.item() != 1:
        return [((known.dimension(node, 0),), None)]
    return [((sympy.expand(end.item() - start.item()),), None)]


@rule("Tile")
def _tile(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, repeats = known.shape(node), known.value(node, 1)
    if shape is None or repeats is None:
        return [UNKNOWN]
    return [(tuple(product(pair) for pair in zip(shape, repeats, strict=True)), None)]


@rule("Pad")
def _pad(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, pads = known.shape(node), known.value(node, 1)
    if shape is None or pads is None or len(pads) != 2 * len(shape):
        return [UNKNOWN]
    both = zip(shape, pads[: len(shape)], pads[len(shape) :], strict=True)
    return [(tuple(sympy.expand(dim + before + after) for dim, before, after in both), None)]
