"""Symbolic shape inference of layers: convolutions, matrix products, reductions, resizing, loops."""

import onnx
import sympy

from .symbolic_shapes import (
    UNKNOWN,
    Result,
    SymbolicShapes,
    attributes,
    broadcast,
    floor_divide,
    quotient,
    rule,
)

ONE = sympy.Integer(1)


@rule("Resize")
def _resize(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, sizes = known.shape(node), known.value(node, 3)
    if sizes is not None:
        return [(tuple(sizes), None)]
    scales = known.scales.get(node.input[2])
    if shape is not None and scales is not None and all(scale == int(scale) for scale in scales):
        return [(tuple(dim * int(scale) for dim, scale in zip(shape, scales, strict=True)), None)]
    return [(tuple(known.dimension(node, axis) for axis in range(len(shape))), None)] if shape else [UNKNOWN]


@rule("Conv", "ConvInteger")
def _convolution(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, kernel, given = known.shape(node), known.shape(node, 1), attributes(node)
    if shape is None or kernel is None:
        return [UNKNOWN]
    spatial = len(shape) - 2
    strides, dilations = given.get("strides", [1] * spatial), given.get("dilations", [1] * spatial)
    pads = given.get("pads", [0] * 2 * spatial)
    dims = [shape[0], kernel[0]]
    for axis in range(spatial):
        total = shape[axis + 2] + pads[axis] + pads[axis + spatial] - dilations[axis] * (kernel[axis + 2] - 1) - 1
        dims.append(sympy.expand(floor_divide(sympy.expand(total), sympy.Integer(strides[axis])) + 1))
    return [(tuple(dims), None)]


@rule("ConvTranspose")
def _transposed_convolution(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, kernel, given = known.shape(node), known.shape(node, 1), attributes(node)
    if shape is None or kernel is None or "output_shape" in given or given.get("group", 1) != 1:
        return [UNKNOWN]
    spatial = len(shape) - 2
    strides, pads = given.get("strides", [1] * spatial), given.get("pads", [0] * 2 * spatial)
    dims = [shape[0], kernel[1]]
    for axis in range(spatial):
        around = pads[axis] + pads[axis + spatial]
        dims.append(sympy.expand((shape[axis + 2] - 1) * strides[axis] + kernel[axis + 2] - around))
    return [(tuple(dims), None)]


@rule("MatMul", "MatMulInteger")
def _matmul(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    left, right = known.shape(node), known.shape(node, 1)
    if left is None or right is None or len(left) < 2 or len(right) < 2:
        return [UNKNOWN]
    batch = broadcast([left[:-2], right[:-2]])
    assert batch is not None
    return [((*batch, left[-2], right[-1]), None)]


@rule("Gemm")
def _gemm(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    left, right, given = known.shape(node), known.shape(node, 1), attributes(node)
    if left is None or right is None:
        return [UNKNOWN]
    return [((left[given.get("transA", 0)], right[1 - given.get("transB", 0)]), None)]


@rule("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin", "ReduceL2", "ReduceProd")
def _reduce(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, given = known.shape(node), attributes(node)
    if shape is None:
        return [UNKNOWN]
    chosen = known.numbers(node, 1, "axes")
    axes = {axis % len(shape) for axis in (chosen if chosen else range(len(shape)))}
    if given.get("keepdims", 1):
        return [(tuple(ONE if axis in axes else dim for axis, dim in enumerate(shape)), None)]
    return [(tuple(dim for axis, dim in enumerate(shape) if axis not in axes), None)]


@rule("ArgMax", "ArgMin")
def _arg(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, given = known.shape(node), attributes(node)
    if shape is None:
        return [UNKNOWN]
    axis = given.get("axis", 0) % len(shape)
    kept = (ONE,) if given.get("keepdims", 1) else ()
    return [(shape[:axis] + kept + shape[axis + 1 :], None)]


@rule("TopK")
def _top(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, count = known.shape(node), known.value(node, 1)
    if shape is None:
        return [UNKNOWN] * 2
    axis = attributes(node).get("axis", -1) % len(shape)
    kept = known.dimension(node, axis) if count is None else count.item()
    found = (*shape[:axis], kept, *shape[axis + 1 :])
    return [(found, None), (found, None)]


@rule("DepthToSpace", "SpaceToDepth")
def _depth_to_space(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    shape, side = known.shape(node), attributes(node)["blocksize"]
    if shape is None:
        return [UNKNOWN]
    count, channels, height, width = shape
    if node.op_type == "DepthToSpace":
        return [((count, quotient(channels, sympy.Integer(side**2)), height * side, width * side), None)]
    return [((count, channels * side**2, floor_divide(height, side), floor_divide(width, side)), None)]


@rule("Loop")
def _loop(known: SymbolicShapes, node: onnx.NodeProto) -> Result:
    """A loop without carried state but the condition: its outputs are those of its steps, stacked."""
    body, steps = attributes(node)["body"], known.value(node, 0)
    if len(body.input) > 2 or steps is None:
        return [UNKNOWN] * len(node.output)
    inner = known.copy()
    inner.infer(body, {value.name: () for value in body.input})
    results: Result = []
    for value in body.output[1:]:
        shape = inner.shapes.get(value.name)
        results.append((None if shape is None else (steps.item(), *shape), None))
    return results
