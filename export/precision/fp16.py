"""Conversion of chosen nodes to fp16, with casts around them; all others stay in float32.

(The converter of onnxruntime.transformers rounds the graph's inputs, too, and cameras do not tolerate that.)
"""

import numpy as np
import onnx

from ..graph.subgraph import replace_nodes


def in_fp16(model: onnx.ModelProto, names: set[str]) -> onnx.ModelProto:
    """A graph that is loaded with its weights, with the nodes of these names in fp16."""
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes: list[onnx.NodeProto] = []
    halved: dict[str, str] = {}  # tensors of which there is a copy in fp16
    for node in model.graph.node:
        if node.name not in names:
            nodes.append(node)
            continue
        for index, name in enumerate(node.input):
            if name not in halved:
                halved[name] = f"{name}.half"
                if name in weights:
                    values = onnx.numpy_helper.to_array(weights[name]).astype(np.float16)
                    model.graph.initializer.append(onnx.numpy_helper.from_array(values, halved[name]))
                else:
                    nodes.append(_cast(node, name, halved[name], onnx.TensorProto.FLOAT16))
            node.input[index] = halved[name]
        result = node.output[0]
        node.output[0] = halved[result] = f"{result}.half"
        nodes += [node, _cast(node, halved[result], result, onnx.TensorProto.FLOAT)]
    replace_nodes(model.graph, nodes)
    return model


def _cast(node: onnx.NodeProto, given: str, result: str, element: int) -> onnx.NodeProto:
    """A cast before or after a node, with a name of the same layer."""
    return onnx.helper.make_node("Cast", [given], [result], name=f"{node.name}/{result}", to=element)
