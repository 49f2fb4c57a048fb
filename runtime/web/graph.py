"""The graph that the page loads: of fixed sizes, folded, since a browser opens fewer nodes sooner."""

import json
from dataclasses import dataclass
from pathlib import Path

import onnxruntime

from ..errors import InputError
from ..images.sizes import describe_size_rule, is_valid_size
from ..inference.metadata import METADATA_KEY
from ..inference.model_files import ModelFiles
from ..inference.onnx_metadata import read_properties
from ..inference.session import FATAL_ONLY
from ..system.files import scratch_folder

VIEWS = 2
WEB_TARGET = "web"  # the `target` in the metadata of a graph that runs on WebGPU
DIMENSIONS = ("views", "height", "width")  # names of the dynamic dimensions in our graphs


@dataclass(frozen=True)
class PageGraph:
    """A graph for `VIEWS` images of height x width.

    content: the .onnx file. webgpu: whether it was exported for WebGPU (its metadata say `"target": "web"`). Other
    graphs hold loops, and convolutions that ONNX Runtime 1.30 computes wrongly on WebGPU, without an error: those of a
    multiple of 3 input channels that is no multiple of 4.
    """

    content: bytes
    height: int
    width: int
    webgpu: bool


def page_graph(model: ModelFiles, size: tuple[int, int] | None = None) -> PageGraph:
    """The graph of a model with its sizes fixed; one that was exported with fixed sizes is taken as it is.

    size: height and width; by default those of the training. Raises InputError for a model that a page cannot run.
    """
    own, path = model.metadata, model.path
    if path.is_dir():
        raise InputError(f"{path}: is a folder of staged graphs, expected one .onnx file; export without --staged")
    if not own.gaussians:
        raise InputError(f"{path}: predicts depth only, expected a model that predicts Gaussians")
    height, width = size or (own.height, own.width)
    if not is_valid_size(height, width, own.size_multiple):
        raise InputError(f"--size {height}x{width}: {describe_size_rule(own.size_multiple)}")
    model.check_size(VIEWS, height, width)
    if own.fixed_size and own.fixed_views:
        return PageGraph(path.read_bytes(), height, width, _target(path) == WEB_TARGET)
    return PageGraph(_fixed(path, (VIEWS, height, width)), height, width, _target(path) == WEB_TARGET)


def _target(path: Path) -> str | None:
    """What the graph was exported for, if it says so."""
    found: str | None = json.loads(read_properties(path)[METADATA_KEY]).get("target")
    return found


def _fixed(path: Path, sizes: tuple[int, int, int]) -> bytes:
    """The graph of a file with these sizes, in standard operators: only ONNX Runtime's basic rewrites are applied."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = FATAL_ONLY
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.enable_mem_reuse = False  # its planning is quadratic in the number of nodes, and nothing is run
    for name, value in zip(DIMENSIONS, sizes, strict=True):
        options.add_free_dimension_override_by_name(name, value)
    with scratch_folder() as folder:
        target = folder / "graph.onnx"
        options.optimized_model_filepath = str(target)
        try:
            onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime raises many kinds, all derived from Exception alone
            raise InputError(f"{path}: ONNX Runtime cannot fix its sizes ({error}); export it again") from None
        return target.read_bytes()
