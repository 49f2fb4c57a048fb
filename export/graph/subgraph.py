"""Sub-graphs and node lists: extraction between tensors, replacement, topological order."""

from collections.abc import Iterable
from graphlib import TopologicalSorter

import onnx


def extract_subgraph(
    traced: onnx.ModelProto, borders: set[str], outputs: Iterable[str]
) -> tuple[list[onnx.NodeProto], set[str]]:
    """The nodes between border tensors and `outputs`, in graph order, and the border tensors that they read."""
    producers = {output: index for index, node in enumerate(traced.graph.node) for output in node.output}
    met, found, pending = set(), set(), list(outputs)
    while pending:
        name = pending.pop()
        if name in borders:
            met.add(name)
        elif name in producers and producers[name] not in found:
            found.add(producers[name])
            pending.extend(names_read(traced.graph.node[producers[name]]))
    return [traced.graph.node[index] for index in sorted(found)], met


def names_read(node: onnx.NodeProto) -> set[str]:
    """The tensors that a node reads, including those that its sub-graphs read from outside."""
    read = set(node.input)
    for attribute in node.attribute:
        if attribute.type == onnx.AttributeProto.GRAPH:
            inner = attribute.g
            own = {value.name for value in (*inner.input, *inner.initializer)}
            own.update(name for step in inner.node for name in step.output)
            read.update(name for step in inner.node for name in names_read(step) if name not in own)
    return read - {""}


def replace_nodes(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> None:
    """Replace a graph's nodes, and remove nodes and weights that nothing reads."""
    read = {name for node in nodes for name in names_read(node)} | {output.name for output in graph.output}
    kept = [weight for weight in graph.initializer if weight.name in read]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(node for node in nodes if read & set(node.output))
    graph.initializer.extend(kept)


def remove_unread(graph: onnx.GraphProto) -> None:
    """Remove nodes, and weights, that no output depends on; nodes may be in any order."""
    producers = {name: index for index, node in enumerate(graph.node) for name in node.output}
    pending, read, kept = [output.name for output in graph.output], set(), set()
    while pending:
        name = pending.pop()
        read.add(name)
        if name in producers and producers[name] not in kept:
            kept.add(producers[name])
            pending.extend(names_read(graph.node[producers[name]]))
    nodes = [node for index, node in enumerate(graph.node) if index in kept]
    weights = [weight for weight in graph.initializer if weight.name in read]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(nodes)
    graph.initializer.extend(weights)


def sort_nodes(graph: onnx.GraphProto) -> None:
    """Sort nodes topologically: ONNX Runtime's tools ignore what is read inside a Loop."""
    producers = {name: index for index, node in enumerate(graph.node) for name in node.output}
    needed = {
        index: {producers[name] for name in names_read(node) if name in producers}
        for index, node in enumerate(graph.node)
    }
    nodes = [graph.node[index] for index in TopologicalSorter(needed).static_order()]
    del graph.node[:]
    graph.node.extend(nodes)
