"""Simplification of a traced graph within standard ONNX."""

from pathlib import Path

import onnx
import onnxruntime

STANDARD_DOMAIN = ""
EXTERNAL_FILE = "session.optimized_model_external_initializers_file_name"


def simplify(path: Path, weights: Path) -> onnx.ModelProto:
    """Fold constants and merge equal nodes with ONNX Runtime's hardware-independent passes; this halves the nodes.

    weights: the file for the result's weights, in the graph's folder.
    """
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(path.with_suffix(".simple.onnx"))
    options.add_session_config_entry(EXTERNAL_FILE, weights.name)
    options.enable_mem_reuse = False  # only planning, and quadratic in the number of nodes
    options.log_severity_level = 3
    onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    model = onnx.load(options.optimized_model_filepath, load_external_data=False)
    standard = [opset for opset in model.opset_import if opset.domain == STANDARD_DOMAIN]
    del model.opset_import[:]
    model.opset_import.extend(standard)
    for node in model.graph.node:
        node.doc_string = ""
    return model
