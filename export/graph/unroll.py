"""Loops over blocks of pixels (gather_loops.py) without a Loop: all blocks at once, or in a few chunks.

GPUs have no use for a Loop: WebGPU has no kernel for it, it rules out graph capture, and elsewhere it dispatches every
step by itself.
"""

import math

import numpy as np
import onnx
import sympy

from .subgraph import remove_unread, sort_nodes
from .symbolic_shapes import Shape, SymbolicShapes, attributes

FLOAT_BYTES = 4
BLOCKS, PIXELS = 0, 1  # axes of what a loop's steps take their parts of


def unroll_loops(
    model: onnx.ModelProto, known: SymbolicShapes, limit: int, sizes: dict[sympy.Symbol, int] | None = None
) -> None:
    """Replace every Loop in place by the nodes of its body.

    limit: bytes that one gathered tensor may have; chunks are as few as that allows. sizes: values of the symbols, for
    which it holds.
    """
    graph = model.graph
    for loop in [node for node in graph.node if node.op_type == "Loop"]:
        _Unrolled(graph, loop, known, limit, sizes or {}).replace()
    remove_unread(graph)
    sort_nodes(graph)


class _Unrolled:
    """The nodes of one Loop."""

    def __init__(
        self,
        graph: onnx.GraphProto,
        loop: onnx.NodeProto,
        known: SymbolicShapes,
        limit: int,
        sizes: dict[sympy.Symbol, int],
    ) -> None:
        self.graph, self.loop, self.known, self.limit, self.sizes = graph, loop, known, limit, sizes
        self.body: onnx.GraphProto = attributes(loop)["body"]
        step = self.body.input[0].name
        # What a step takes its part of, by the name of the part.
        self.parts = {
            node.output[0]: node.input[0]
            for node in self.body.node
            if node.op_type == "Gather" and node.input[1] == step
        }

    def replace(self) -> None:
        """Write the body's nodes once for each chunk, and concatenate what they yield."""
        count, result = self._chunks(), self.loop.output[0]
        pieces = {part: self._split(whole, count) for part, whole in self.parts.items()}
        results = []
        for index in range(count):
            names = {part: piece[index] for part, piece in pieces.items()}
            for node in self.body.node:
                if node.output[0] in self.parts or node.op_type == "Identity":
                    continue
                copy = onnx.NodeProto()
                copy.CopyFrom(node)
                copy.input[:] = [names.get(name, name) for name in node.input]
                copy.name = names[node.output[0]] = copy.output[0] = f"{self.loop.name}/{node.output[0]}.{index}"
                self.graph.node.append(copy)
            results.append(names[self.body.output[1].name])
        name = f"{self.loop.name}/Concat"
        self.graph.node.append(onnx.helper.make_node("Concat", results, [result], name=name, axis=PIXELS))
        self.graph.node.remove(self.loop)

    def _chunks(self) -> int:
        """The fewest chunks of a block's pixels, a divisor of their number, that keep gathered tensors in the limit."""
        shapes = {name: shape for name in self.parts.values() if (shape := self.known.shapes.get(name)) is not None}
        pixels = {int(shape[PIXELS]) for shape in shapes.values()}
        (number,) = pixels
        gathered = max(map(self._bytes, self._gathered(shapes)), default=0)
        divisors = [count for count in range(1, number + 1) if number % count == 0]
        return next((count for count in divisors if gathered <= count * self.limit), number)

    def _gathered(self, shapes: dict[str, Shape]) -> list[Shape]:
        """The shapes of what the body gathers by a part: rows of a table."""
        found = []
        for node in self.body.node:
            rows = shapes.get(self.parts.get(node.input[1], "")) if node.op_type == "Gather" else None
            table = self.known.shapes.get(node.input[0])
            if rows is not None and table is not None:
                found.append((*rows, *table[1:]))
        return found

    def _bytes(self, shape: Shape) -> int:
        return FLOAT_BYTES * math.prod(int(dim.subs(self.sizes)) for dim in shape)

    def _split(self, name: str, count: int) -> list[str]:
        """The chunks of a tensor along its pixels."""
        if count == 1:
            return [name]
        chunks = [f"{self.loop.name}.{name}.{index}" for index in range(count)]
        sizes = f"{chunks[0]}.sizes"  # given, since opset 17 has no number of outputs
        shape = self.known.shapes[name]
        assert shape is not None
        parts = np.full(count, int(shape[PIXELS]) // count, np.int64)
        self.graph.initializer.append(onnx.numpy_helper.from_array(parts, sizes))
        node = onnx.helper.make_node("Split", [name, sizes], chunks, name=f"{chunks[0]}/Split", axis=PIXELS)
        self.graph.node.append(node)
        return chunks
