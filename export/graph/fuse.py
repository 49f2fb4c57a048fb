"""Groups of nodes that PyTorch's exporter writes, as fewer nodes that compute the same."""

from collections import defaultdict

import numpy as np
import onnx

from .subgraph import names_read, remove_unread
from .symbolic_shapes import SymbolicShapes


def fuse_nodes(model: onnx.ModelProto, known: SymbolicShapes) -> None:
    """Fuse group norms and the scales of attention in place.

    known: shapes of the graph's tensors, which are to be inferred again afterwards. Results are equal but for the
    rounding of attention's scales.
    """
    graph = _Graph(model.graph)
    for node in list(model.graph.node):
        if node.op_type == "InstanceNormalization":
            _fuse_group_norm(graph, node, known)
        elif node.op_type == "MatMul":
            _fuse_scales(graph, node)
    remove_unread(model.graph)


class _Graph:
    """A graph with the producer and the readers of each tensor."""

    def __init__(self, graph: onnx.GraphProto) -> None:
        self.graph = graph
        self.weights = {tensor.name: tensor for tensor in graph.initializer}
        self.producers = {name: node for node in graph.node for name in node.output}
        self.readers: dict[str, list[onnx.NodeProto]] = defaultdict(list)
        for node in graph.node:
            for name in names_read(node):
                self.readers[name].append(node)
        self.outputs = {value.name for value in graph.output}

    def only_reader(self, name: str, operator: str) -> onnx.NodeProto | None:
        """The node that reads a tensor, if it is the only one and of this operator."""
        readers = self.readers[name]
        if name in self.outputs or len(readers) != 1 or readers[0].op_type != operator:
            return None
        return readers[0]

    def producer(self, name: str, operator: str) -> onnx.NodeProto | None:
        """The node that makes a tensor, if it is of this operator."""
        node = self.producers.get(name)
        return node if node is not None and node.op_type == operator else None

    def constant(self, name: str, values: np.ndarray) -> str:
        """The name of an initialiser, which is added unless it is there."""
        if name not in self.weights:
            self.weights[name] = self.graph.initializer.add()
            self.weights[name].CopyFrom(onnx.numpy_helper.from_array(values, name))
        return name

    def vector(self, name: str) -> str:
        """A weight of one value a channel, [channels, 1, ...], as a vector; the original stays for other readers."""
        flat = f"{name}.vector"
        if flat not in self.weights:
            self.weights[flat] = self.graph.initializer.add()
            self.weights[flat].CopyFrom(self.weights[name])
            self.weights[flat].name = flat
            size = int(np.prod(self.weights[name].dims))
            del self.weights[flat].dims[:]
            self.weights[flat].dims.append(size)
        return flat


def _fuse_group_norm(graph: _Graph, norm: onnx.NodeProto, known: SymbolicShapes) -> None:
    """Reshape to groups, InstanceNormalization, Reshape back, Mul, Add -> the same without arithmetic on shapes.

    With one channel a group, an InstanceNormalization has the weights itself. Otherwise a BatchNormalization of mean 0
    and variance 1 takes the place of Mul and Add.
    """
    before = graph.producer(norm.input[0], "Reshape")
    after = graph.only_reader(norm.output[0], "Reshape")
    multiply = graph.only_reader(after.output[0], "Mul") if after else None
    add = graph.only_reader(multiply.output[0], "Add") if multiply else None
    if before is None or after is None or multiply is None or add is None:
        return
    scale, bias = (node.input[1] for node in (multiply, add))
    shape, grouped = known.shapes.get(before.input[0]), known.shapes.get(norm.input[0])
    if scale not in graph.weights or bias not in graph.weights or shape is None or grouped is None:
        return
    channels, groups = shape[1], grouped[1]
    if known.shapes.get(after.output[0]) != shape or shape[0] != grouped[0]:
        return
    if list(graph.weights[scale].dims)[:1] != [channels] or list(graph.weights[bias].dims)[:1] != [channels]:
        return
    weights = [graph.vector(scale), graph.vector(bias)]
    if channels == groups:
        norm.input[0] = before.input[0]
        norm.input[1:] = weights
        norm.output[0] = add.output[0]
        for node in (after, multiply, add):
            graph.graph.node.remove(node)
        return
    if len(shape) == 4:  # the width stays where it is, and so no target depends on the size
        forward, back = [0, int(groups), -1, 0], [0, int(channels), -1, 0]
        before = _copy_reshape(graph, before, norm, forward)
        after.input[1] = _target(graph, back)
    zero, one = (
        graph.constant(f"norm.{int(channels)}.{name}", np.full(int(channels), value, np.float32))
        for name, value in (("mean", 0), ("variance", 1))
    )
    affine = onnx.helper.make_node(
        "BatchNormalization", [after.output[0], *weights, zero, one], [add.output[0]], name=multiply.name, epsilon=0.0
    )
    _replace(graph.graph, multiply, affine)
    graph.graph.node.remove(add)


def _copy_reshape(graph: _Graph, reshape: onnx.NodeProto, reader: onnx.NodeProto, target: list[int]) -> onnx.NodeProto:
    """A Reshape to another target for one reader alone."""
    copy = onnx.NodeProto()
    copy.CopyFrom(reshape)
    copy.name = copy.output[0] = f"{reader.output[0]}.groups"
    copy.input[1] = _target(graph, target)
    reader.input[0] = copy.output[0]
    graph.graph.node.insert(list(graph.graph.node).index(reader), copy)
    return copy


def _target(graph: _Graph, dims: list[int]) -> str:
    return graph.constant(f"shape.{'.'.join(map(str, dims))}", np.array(dims, np.int64))


def _replace(graph: onnx.GraphProto, old: onnx.NodeProto, new: onnx.NodeProto) -> None:
    graph.node.insert(list(graph.node).index(old), new)
    graph.node.remove(old)


def _fuse_scales(graph: _Graph, matmul: onnx.NodeProto) -> None:
    """Multiply the queries by the square of a constant, where queries and keys are each multiplied by it."""
    left, right = (graph.producer(name, "Mul") for name in matmul.input)
    if left is None or right is None or left.input[1] != right.input[1]:
        return
    scale = graph.weights.get(left.input[1])
    if scale is None or scale.dims or len(graph.readers[left.output[0]]) > 1:
        return
    if left.output[0] in graph.outputs or left.output[0] == right.output[0]:
        return
    value = onnx.numpy_helper.to_array(scale)
    left.input[1] = graph.constant(f"{scale.name}.squared", np.square(value))
    matmul.input[1] = right.input[0]
