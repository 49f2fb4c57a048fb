"""Trace a network once to one ONNX graph, and split it into the stages' graphs."""

import copy
import logging
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import onnx
import sympy
import torch

from ..runtime.inference.metadata import INPUTS, METADATA_KEY, OUTPUTS, ModelMetadata
from .example_inputs import example_inputs, room_inputs
from .graph.cleanup import simplify
from .graph.external_data import fill_inputs
from .graph.fold_shapes import declare_shapes, fold_shapes
from .graph.fuse import fuse_nodes
from .graph.gather_loops import chunked, lower_custom_ops
from .graph.symbolic_shapes import SymbolicShapes
from .graph.unroll import unroll_loops
from .graph.webgpu import pad_channels, replace_rounding
from .precision.convert import convert_precision
from .precision.int8 import Feeds
from .stages import NamedTensors, Stage, find_stages, stage_graph
from .targets import MAX_TRACED_OPSET, OPSET, WEB, GraphSettings

# Of opset 20 and later; earlier opsets, which are for older runtimes, have the least that fits them.
IR_VERSION = 10
DEFAULT_SETTINGS = GraphSettings()
# Numbers of views and blocks of the inputs that are traced, as few as a network takes, to save time: more give the
# same graph, byte for byte. The graph runs at any.
TRACE_VIEWS = 2
TRACE_BLOCKS = (2, 3)
# Of the inputs from which ranges for int8 are taken.
RANGE_VIEWS = 4
RANGE_BLOCKS = (6, 8)
DYNAMIC = {
    "images": {0: "views", 2: "height", 3: "width"},
    "extrinsics": {0: "views"},
    "intrinsics": {0: "views"},
    "near": {0: "views"},
    "far": {0: "views"},
    "depth": {0: "views", 1: "height", 2: "width"},
    **{name: {0: "gaussians"} for name in OUTPUTS if name != "depth"},
}
PRODUCER = "idesplat"
# Files of the working folder.
TRACED, TRACED_WEIGHTS, WEIGHTS, WHOLE = "traced.onnx", "traced.weights", "weights", "whole.onnx"


@dataclass(frozen=True)
class StaticShape:
    """Dimensions that are constants of the graph; None keeps them dynamic. size: height and width."""

    views: int | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Graphs:
    """The graphs of a traced network, whole and by stage, as files in one folder with one file of weights for all."""

    folder: Path
    stages: list[Stage]
    # Of the whole graph.
    nodes: int

    @property
    def whole(self) -> Path:
        """The graph with only the network's outputs."""
        return self.folder / WHOLE

    @property
    def bytes(self) -> int:
        """The size of the whole graph with its weights."""
        return self.whole.stat().st_size + (self.folder / WEIGHTS).stat().st_size

    def of_stage(self, stage: Stage) -> Path:
        """The graph of a stage."""
        return self.folder / f"stage.{stage.name}.onnx"


def export_graphs(
    network: NamedTensors,
    metadata: ModelMetadata,
    static: StaticShape,
    folder: Path,
    settings: GraphSettings = DEFAULT_SETTINGS,
) -> Graphs:
    """Trace a network and split it into stages: files in an empty folder, checked by ONNX's checker."""
    dims = _Dimensions.of(metadata, static)
    traced = trace(network, metadata, static, folder, min(settings.opset, MAX_TRACED_OPSET))
    traced.opset_import[0].version = settings.opset
    known = dims.infer(traced)
    fuse_nodes(traced, known)
    if settings.target.gather_bytes is not None:
        unroll_loops(traced, known, settings.target.gather_bytes, dims.sizes)
        replace_rounding(traced)
    if settings.target.name == WEB:
        pad_channels(traced, folder)
    layers = network.family.quantizable
    examples = settings.calibration or _examples(metadata, static)
    traced = convert_precision(metadata.precision, traced, folder / WEIGHTS, layers, examples)
    known = dims.infer(traced)
    whole = _whole_graph(traced)
    _fold(whole, known, dims)
    graphs = Graphs(folder, find_stages(traced, network.stages), len(whole.graph.node))
    _write(whole, metadata, graphs.whole)
    for stage in graphs.stages:
        part = stage_graph(traced, stage)
        _fold(part, known, dims)
        _write(part, metadata, graphs.of_stage(stage))
    return graphs


@dataclass(frozen=True)
class _Dimensions:
    """The inputs' dimensions as expressions.

    inputs: by name. names: the symbols in terms of the declared dimensions. sizes: the trained size and most views.
    """

    inputs: dict[str, tuple[sympy.Expr | int, ...]]
    names: dict[sympy.Symbol, sympy.Expr]
    sizes: dict[sympy.Symbol, int]

    @classmethod
    def of(cls, metadata: ModelMetadata, static: StaticShape) -> "_Dimensions":
        """Of a model: height and width are multiples of `size_multiple`."""
        multiple = metadata.size_multiple
        symbols = [sympy.Symbol(name, integer=True, positive=True) for name in ("views", "rows", "columns")]
        views: sympy.Expr | int = static.views or symbols[0]
        height, width = static.size or (multiple * symbols[1], multiple * symbols[2])
        shapes = ((views, 3, height, width), (views, 4, 4), (views, 3, 3), (views,), (views,))
        names = {symbols[1]: sympy.Symbol("height") / multiple, symbols[2]: sympy.Symbol("width") / multiple}
        trained = (metadata.trained_views[-1], metadata.height // multiple, metadata.width // multiple)
        return cls(dict(zip(INPUTS, shapes, strict=True)), names, dict(zip(symbols, map(int, trained), strict=True)))

    def infer(self, model: onnx.ModelProto) -> SymbolicShapes:
        """The shapes of a graph of the whole network."""
        known = SymbolicShapes()
        known.infer(model.graph, self.inputs)
        return known


def _fold(model: onnx.ModelProto, known: SymbolicShapes, dims: _Dimensions) -> None:
    """Fold a graph's shape arithmetic, and declare the shapes of its tensors."""
    own = known.copy()
    fold_shapes(model, own, [value.name for value in model.graph.input])
    declare_shapes(model, own, dims.names)


def _examples(metadata: ModelMetadata, static: StaticShape) -> Iterator[Feeds]:
    """Calibration inputs: noise and a synthetic room, in portrait and landscape format."""
    across = tuple(blocks * metadata.size_multiple for blocks in RANGE_BLOCKS)
    for height, width in [static.size] if static.size else [across, across[::-1]]:
        for make in (example_inputs, room_inputs):
            inputs = make(static.views or RANGE_VIEWS, height, width, metadata.near, metadata.far)
            yield {name: tensor.numpy() for name, tensor in inputs.items()}


def trace(
    network: NamedTensors, metadata: ModelMetadata, static: StaticShape, folder: Path, opset: int = OPSET
) -> onnx.ModelProto:
    """Trace the network with every tensor between stages as an output; its weights go to a file in the folder.

    torch.onnx's TorchScript exporter is used because with dynamic views, height and width torch.export 2.13 spends
    minutes on symbolic shapes, even for a network of a tenth of the size. The exporter is not given the weights, of
    which it would hold several copies.
    """
    inputs = _noise(metadata, static)
    path, weights = folder / TRACED, folder / TRACED_WEIGHTS
    with warnings.catch_warnings(), torch.no_grad(), chunked(network):
        warnings.simplefilter("ignore")  # the exporter's deprecation, and tracing warnings about static dimensions
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        shapes = {name: tuple(tensor.shape) for name, tensor in network.named(*inputs).items()}
        axes = _dynamic_axes(shapes, static)
        torch.onnx.export(
            network,
            inputs,
            str(path),
            dynamo=False,
            export_params=False,
            do_constant_folding=False,  # folded weights lose their names; `simplify` folds them later
            opset_version=opset,
            input_names=list(INPUTS),
            output_names=list(shapes),
            dynamic_axes=axes,
        )
    traced = lower_custom_ops(onnx.load(path), opset)
    fill_inputs(traced, [*network.named_parameters(), *network.named_buffers()], weights)
    path.write_bytes(traced.SerializeToString())
    model = simplify(path, folder / WEIGHTS)
    weights.unlink()
    _declare_shapes(model, shapes, axes)
    return model


def _noise(metadata: ModelMetadata, static: StaticShape) -> tuple[torch.Tensor, ...]:
    """Inputs of noise, small where the graph's dimensions are dynamic."""
    height, width = static.size or (blocks * metadata.size_multiple for blocks in TRACE_BLOCKS)
    return tuple(example_inputs(static.views or TRACE_VIEWS, height, width, metadata.near, metadata.far).values())


def _dynamic_axes(shapes: dict[str, tuple[int, ...]], static: StaticShape) -> dict[str, dict[int, str]]:
    """Names of the dynamic dimensions by tensor and axis; maps between stages have names of their own."""
    boundaries = {
        name: {0: "views", 2: f"{name}.height", 3: f"{name}.width"}
        if len(shape) == 4
        else {0: "views", 1: "neighbours"}
        for name, shape in shapes.items()
        if "." in name
    }

    def is_dynamic(dimension: str) -> bool:
        depends_on_views = dimension in ("views", "neighbours", "gaussians")
        depends_on_size = dimension == "gaussians" or not depends_on_views
        return (depends_on_views and not static.views) or (depends_on_size and not static.size)

    axes = {**DYNAMIC, **boundaries}
    return {name: {axis: dim for axis, dim in dims.items() if is_dynamic(dim)} for name, dims in axes.items()}


def _declare_shapes(
    model: onnx.ModelProto, shapes: dict[str, tuple[int, ...]], axes: dict[str, dict[int, str]]
) -> None:
    """Restore the outputs' dimension names, which the simplification replaces."""
    for output in model.graph.output:
        dims = [axes[output.name].get(axis, size) for axis, size in enumerate(shapes[output.name])]
        element = output.type.tensor_type.elem_type
        output.CopyFrom(onnx.helper.make_tensor_value_info(output.name, element, dims))


def _whole_graph(traced: onnx.ModelProto) -> onnx.ModelProto:
    model = copy.deepcopy(traced)
    outputs = [output for output in model.graph.output if output.name in OUTPUTS]
    del model.graph.output[:]
    model.graph.output.extend(sorted(outputs, key=lambda output: OUTPUTS.index(output.name)))
    return model


def _write(model: onnx.ModelProto, metadata: ModelMetadata, path: Path) -> None:
    """Add the metadata to a graph, and save and check it."""
    opset = model.opset_import[0].version
    model.ir_version = IR_VERSION if opset >= OPSET else onnx.helper.find_min_ir_version_for(model.opset_import)
    model.producer_name, model.producer_version = PRODUCER, metadata.version
    model.doc_string = f"{metadata.preset} exported by idesplat {metadata.version}"
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {METADATA_KEY: metadata.to_json()})
    path.write_bytes(model.SerializeToString())
    onnx.checker.check_model(str(path), full_check=True)
