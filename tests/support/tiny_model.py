"""A graph of a few nodes that passes for a network: quick to make, and to make wrong."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx.parser
from idesplat.runtime.inference.metadata import METADATA_KEY, ModelMetadata
from onnx import helper
from views_in_a_row import extrinsics_in_a_row

OWN = ModelMetadata(
    preset="tiny",
    height=64,
    width=96,
    size_multiple=16,
    fixed_size=False,
    fixed_views=0,
    near=0.5,
    far=100.0,
    trained_views=[2, 3],
    trained_sides=[64, 96],
    sh_degree=0,
    checkpoint="last.ckpt",
    checkpoint_sha256="0" * 64,
    version="0.1.0",
)
# What takes images [views, 3, height, width] and the like and yields Gaussians that are all alike.
NETWORK = """<ir_version: 10, opset_import: ["": 20]>
net (float[views, 3, height, width] images, float[views, 4, 4] extrinsics, float[views, 3, 3] intrinsics,
     float[views] near, float[views] far)
 => (float[views, height, width] depth, float[gaussians, 3] means, float[gaussians, 3] scales,
     float[gaussians, 4] quats, float[gaussians] opacities, float[gaussians, 1, 3] sh) {
    one = Constant <value_floats = [1.0]> ()
    flat = Constant <value_ints = [-1]> ()
    three = Constant <value_ints = [-1, 3]> ()
    bands = Constant <value_ints = [-1, 1, 3]> ()
    channel = Constant <value_ints = [1]> ()
    mean = ReduceMean <keepdims = 0> (images, channel)
    depth = Add (mean, one)
    opacities0 = Reshape (mean, flat)
    opacities = Clip (opacities0)
    rows = Transpose <perm = [0, 2, 3, 1]> (images)
    means = Reshape (rows, three)
    scales = Abs (means)
    sh = Reshape (rows, bands)
    column = Constant <value_ints = [-1, 1]> ()
    w = Reshape (opacities0, column)
    quats = Concat <axis = 1> (w, means)
}"""


def write_model(path: Path, text: str = NETWORK, **changes: object) -> Path:
    """Write a graph with the metadata OWN, of which fields may be changed; the path."""
    model = onnx.parser.parse_model(text)
    helper.set_model_props(model, {METADATA_KEY: json.dumps(asdict(OWN) | changes)})
    path.write_bytes(model.SerializeToString())
    return path


def arrays(views: int = 2, height: int = 32, width: int = 48) -> dict[str, np.ndarray]:
    """Inputs of such a graph: images of noise, cameras side by side, normalized intrinsics."""
    images = np.random.default_rng(0).random((views, 3, height, width), np.float32)
    extrinsics = extrinsics_in_a_row(*range(views)).astype(np.float32)
    K = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], np.float32)
    return {"images": images, "extrinsics": extrinsics, "intrinsics": np.tile(K, (views, 1, 1))}
