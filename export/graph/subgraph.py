"""The nodes of a graph: what they read, which lie between tensors, others in their place, their order."""

from collections.abc import Iterable
from graphlib import TopologicalSorter

import onnx


def extract_subgraph(
    traced: onnx.ModelProto, borders: set[str], outputs: Iterable[str]
) -> tuple[list[onnx.NodeProto], set[str]]:
    """The nodes on every way back from `outputs` to the first border tensors, in their order, and those tensors."""
    producers = {output: index for index, node in enumerate(traced.graph.node) for output in node.output}
    met, found, open_names = set(), set(), list(outputs)
    while open_names:
        name = open_names.pop()
        if name in borders:
            met.add(name)
        elif name in producers and producers[name] not in found:
            found.add(producers[name])
            open_names.extend(names_read(traced.graph.node[producers[name]]))
    return [traced.graph.node[index] for index in sorted(found)], met


def names_read(node: onnx.NodeProto) -> set[str]:
    """The tensors that a node reads, those included that the graphs inside it take from around it."""
    read = set(node.input)
    for attribute in node.attribute:
        if attribute.type == onnx.AttributeProto.GRAPH:
            inner = attribute.g
            own = {value.name for value in (*inner.input, *inner.initializer)}
            own.update(name for step in inner.node for name in step.output)
            read.update(name for step in inner.node for name in names_read(step) if name not in own)
    return read - {""}


def replace_nodes(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> None:
    """Give a graph other nodes, without those and the weights whose result nobody reads."""
    read = {name for node in nodes for name in names_read(node)} | {output.name for output in graph.output}
    kept = [weight for weight in graph.initializer if weight.name in read]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(node for node in nodes if read & set(node.output))
    graph.initializer.extend(kept)


def sort_nodes(graph: onnx.GraphProto) -> None:
    """Put nodes after those whose results they read: ONNX Runtime's tools forget what is read inside a Loop."""
    producers = {name: index for index, node in enumerate(graph.node) for name in node.output}
    needed = {
        index: {producers[name] for name in names_read(node) if name in producers}
        for index, node in enumerate(graph.node)
    }
    nodes = [graph.node[index] for index in TopologicalSorter(needed).static_order()]
    del graph.node[:]
    graph.node.extend(nodes)
