"""What WebGPU lacks, or computes wrongly, in terms of what it computes."""

from pathlib import Path

import numpy as np
import onnx

from .subgraph import remove_unread

# onnxruntime-web 1.30 reads channels in vectors of three where their number is a multiple of three and not of four,
# and then convolves wrongly unless they are three (microsoft/onnxruntime#29651).
VECTOR, WRONG_VECTOR = 4, 3


def replace_rounding(model: onnx.ModelProto) -> None:
    """Round as Floor of what is half more, in place: WebGPU has no kernel for Round.

    The two differ where a number is exactly between two integers: Round then takes the even one.
    """
    half = "rounding.half"
    rounds = [node for node in model.graph.node if node.op_type == "Round"]
    for node in rounds:
        raised = f"{node.output[0]}.raised"
        add = onnx.helper.make_node("Add", [node.input[0], half], [raised], name=f"{node.name}/Add")
        floor = onnx.helper.make_node("Floor", [raised], list(node.output), name=node.name)
        model.graph.node.insert(list(model.graph.node).index(node), add)
        _replace(model.graph, node, floor)
    if rounds:
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(0.5, np.float32), half))


def pad_channels(model: onnx.ModelProto, folder: Path) -> None:
    """Give convolutions that WebGPU computes wrongly channels of zeros, in place.

    folder: of the file of the graph's weights.
    """
    graph = model.graph
    weights = {tensor.name: tensor for tensor in graph.initializer}
    for node in [node for node in graph.node if node.op_type == "Conv" and node.input[1] in weights]:
        kernel = weights[node.input[1]]
        channels, groups = kernel.dims[1], [entry.i for entry in node.attribute if entry.name == "group"]
        if (
            channels % WRONG_VECTOR
            or channels in (0, WRONG_VECTOR)
            or channels % VECTOR == 0
            or groups not in ([], [1])
        ):
            continue
        missing, spatial = -channels % VECTOR, len(kernel.dims) - 2
        values = onnx.numpy_helper.to_array(kernel, str(folder))
        wide = np.pad(values, [(0, 0), (0, missing), *[(0, 0)] * spatial])
        pads = np.array([0, 0, *[0] * spatial, 0, missing, *[0] * spatial], np.int64)
        names = f"{node.name}.kernel", f"{node.name}.pads"
        graph.initializer.extend(
            onnx.numpy_helper.from_array(value, name) for value, name in zip((wide, pads), names, strict=True)
        )
        padded = f"{node.name}.padded"
        pad = onnx.helper.make_node("Pad", [node.input[0], names[1]], [padded], name=f"{node.name}/Pad")
        graph.node.insert(list(graph.node).index(node), pad)
        node.input[0], node.input[1] = padded, names[0]
    remove_unread(graph)


def _replace(graph: onnx.GraphProto, old: onnx.NodeProto, new: onnx.NodeProto) -> None:
    graph.node.insert(list(graph.node).index(old), new)
    graph.node.remove(old)
