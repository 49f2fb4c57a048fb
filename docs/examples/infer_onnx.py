"""Run an exported graph with onnxruntime and NumPy alone.

python infer_onnx.py MODEL TENSORS VIEWS HEIGHT WIDTH

TENSORS is a folder that write_tensors.py wrote; the outputs are written beside the inputs, as raw float32 files.
"""

import sys
from pathlib import Path

import numpy as np
import onnxruntime


def main() -> None:
    """Read the inputs, run the graph, and write the outputs."""
    model, folder = sys.argv[1], Path(sys.argv[2])
    views, height, width = map(int, sys.argv[3:6])
    shapes = {
        "images": (views, 3, height, width),
        "extrinsics": (views, 4, 4),
        "intrinsics": (views, 3, 3),
        "near": (views,),
        "far": (views,),
    }
    inputs = {name: np.fromfile(folder / f"{name}.f32", "<f4").reshape(shape) for name, shape in shapes.items()}

    options = onnxruntime.SessionOptions()
    options.enable_mem_reuse = False  # opens a graph of thousands of nodes several times faster
    options.add_session_config_entry("session.x64quantprecision", "1")  # int8 is wrong on some CPUs without it
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    for name, values in zip(names, session.run(names, inputs), strict=True):
        values.astype("<f4").tofile(folder / f"{name}.f32")
        print(name, *values.shape)


if __name__ == "__main__":
    main()
