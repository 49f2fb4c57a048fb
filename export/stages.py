"""The stages of a network and the tensors between them, by the names that classes, files, manifest and report share.

A stage is a child module of the network; `encoder.features_mv` is a field of what the stage `encoder` returns. Which of
these a later stage reads is determined from the traced graph.
"""

from dataclasses import dataclass

import onnx
from torch import Tensor, nn

from ..model.common.network import Network
from ..model.registry import family_of
from ..runtime.inference.metadata import INPUTS
from .graph.subgraph import extract_subgraph, names_read


@dataclass(frozen=True)
class Stage:
    """One part of the network between named tensors."""

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class NamedTensors(nn.Module):
    """A network with every tensor between its stages as an output, by name."""

    def __init__(self, model: Network) -> None:
        super().__init__()
        self.model = model
        self.stages = model.stage_names
        self.family = family_of(model.config)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The graph's inputs, as `INPUTS` names them -> the tensors of `named`, in its order."""
        return tuple(self.named(*inputs).values())

    def named(self, *inputs: Tensor) -> dict[str, Tensor]:
        """The fields that every stage before the last returns, and the network's outputs."""
        return self.model.named_tensors(*inputs)


def find_stages(traced: onnx.ModelProto, names: list[str]) -> list[Stage]:
    """The stages of a traced graph in the order in which they run, each with the tensors that it reads and provides.

    names: of the stages, in order. Outputs that no later stage reads are left out.
    """
    named = [output.name for output in traced.graph.output]
    results = [name for name in named if "." not in name]  # the last stage's
    needed, stages = set(results), []
    for stage in reversed(names):
        own = results if stage == names[-1] else [name for name in named if name.startswith(f"{stage}.")]
        outputs = [name for name in own if name in needed]
        borders = {*INPUTS, *named} - set(own)
        read = extract_subgraph(traced, borders, outputs)[1]
        stages.append(Stage(stage, tuple(name for name in (*INPUTS, *named) if name in read), tuple(outputs)))
        needed |= read
    return stages[::-1]


def stage_graph(traced: onnx.ModelProto, stage: Stage) -> onnx.ModelProto:
    """A stage's sub-graph of a traced graph, as a graph of its own."""
    nodes, _ = extract_subgraph(traced, set(stage.inputs), stage.outputs)
    read = {name for node in nodes for name in names_read(node)} | set(stage.outputs)
    values = {value.name: value for value in (*traced.graph.input, *traced.graph.output)}
    inputs, outputs = ([values[name] for name in names] for names in (stage.inputs, stage.outputs))
    weights = [weight for weight in traced.graph.initializer if weight.name in read]
    graph = onnx.helper.make_graph(nodes, stage.name, inputs, outputs, weights)
    return onnx.helper.make_model(graph, opset_imports=traced.opset_import)
