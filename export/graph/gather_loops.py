"""Gather attention in ONNX, chunked: an ONNX Loop over a few pixels at a time.

A pixel gathers some hundred rows of features. Gathered for all pixels at once they fill gigabytes, which pass through
memory three times. Gathered for a few pixels they stay in the CPU's cache, where a MatMul consumes them. A Loop is one
node, whatever the image size. (A Scan is as fast, but OpenVINO refuses one whose body reads a tensor from outside, as
the table is.)
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import onnx.inliner
import onnx.parser
import torch
from torch import Tensor, nn

from ...model.common.gather_attention import GatherAttention, gathered_dot, gathered_weighted_sum

# With fewer values than this to gather a pixel, the loop costs more than it saves.
FEW = 256
# Candidates of all pixels that are gathered at a time then. One at a time takes as much memory, and more nodes.
CANDIDATES_AT_A_TIME = 2
# While a network is traced, each operation is one node of this domain, defined by the functions below.
DOMAIN = "idesplat"
# What both operations share: rows [pairs, candidates, h * w], table [rows, channels] and `by_pixel` [pairs, h * w, ...]
# -> products [steps, step, ...] of the pixels of each step, reshaped to `shape`, with the rows that they gather. A step
# takes a block: 16 pixels in the releases' coarsest maps, which gather most, 256 in the finest.
STEPS = """
        candidates = Shape <start = 1, end = 2> (rows)
        pixels = Shape <start = 2, end = 3> (rows)
        channels = Shape <start = 1, end = 2> (table)
        all = Constant <value_ints = [-1]> ()
        step = Constant <value_ints: ints = @step> ()
        one = Constant <value_ints = [1]> ()
        rows_shape = Concat <axis = 0> (step, candidates)
        rows_by_pixel = Transpose <perm = [0, 2, 1]> (rows)
        rows_by_step = Reshape (rows_by_pixel, rows_shape)
        shape = Concat <axis = 0> (step, {shape})
        by_step = Reshape ({by_pixel}, shape)
        steps_shape = Shape <start = 0, end = 1> (rows_by_step)
        steps = Squeeze (steps_shape)
        go = Constant <value = bool {{1}}> ()
        products = Loop <body = a_step (int64 i, bool going) => (bool go_on, float[p, a, b] product) {{
            go_on = Identity (going)
            some_rows = Gather (rows_by_step, i)
            some = Gather (by_step, i)
            gathered = Gather (table, some_rows)
            product = MatMul ({product})
        }}> (steps, go)
"""
GATHERED_DOT = """gathered_dot <step> (queries, table, rows) => (scores) {{
        {steps}
        scores_shape = Concat <axis = 0> (all, pixels, candidates)
        scores_by_pixel = Reshape (products, scores_shape)
        scores = Transpose <perm = [0, 2, 1]> (scores_by_pixel)
    }}""".format(steps=STEPS.format(shape="channels, one", by_pixel="queries", product="gathered, some"))
GATHERED_WEIGHTED_SUM = """gathered_weighted_sum <step> (probability, table, rows) => (sums) {{
        weights = Transpose <perm = [0, 2, 1]> (probability)
        {steps}
        sums_shape = Concat <axis = 0> (all, pixels, channels)
        sums = Reshape (products, sums_shape)
    }}""".format(steps=STEPS.format(shape="one, candidates", by_pixel="weights", product="some, gathered"))


@contextmanager
def chunked(network: nn.Module) -> Iterator[None]:
    """Within this context, a network's gather attention is traced as custom nodes, for `lower_custom_ops`.

    Where few values are gathered a pixel, it is traced as it is, with a few candidates of all pixels at a time.
    """
    modules = [part for part in network.modules() if isinstance(part, GatherAttention)]
    for part in modules:
        if part.gathers < FEW:
            part.gathered_dot = partial(gathered_dot, chunk=CANDIDATES_AT_A_TIME)
            part.gathered_weighted_sum = partial(gathered_weighted_sum, chunk=CANDIDATES_AT_A_TIME)
        else:
            part.gathered_dot = partial(_GatheredDot.apply, part.block)
            part.gathered_weighted_sum = partial(_GatheredWeightedSum.apply, part.block)
    try:
        yield
    finally:
        for part in modules:
            part.gathered_dot, part.gathered_weighted_sum = gathered_dot, gathered_weighted_sum


def lower_custom_ops(traced: onnx.ModelProto, opset: int = 20) -> onnx.ModelProto:
    """The graph of this opset with standard operators in place of the custom nodes of `chunked`, named after these."""
    products = {node.output[0]: node.name for node in traced.graph.node if node.domain == DOMAIN}
    header = f'<domain: "{DOMAIN}", opset_import: ["": {opset}]>'
    for text in (GATHERED_DOT, GATHERED_WEIGHTED_SUM):
        traced.functions.append(onnx.parser.parse_function(f"{header} {text}"))
    model = onnx.inliner.inline_local_functions(traced)
    name = ""
    for node in reversed(model.graph.node):  # the output is that of the last of a function's nodes
        name = products.get(node.output[0], name)
        if not node.name:
            _name(node, name)
    return model


def _name(node: onnx.NodeProto, scope: str) -> None:
    """Name a node, and the nodes of its sub-graphs."""
    node.name = f"{scope}/{node.output[0]}"
    for attribute in node.attribute:
        for inner in attribute.g.node:
            _name(inner, node.name)


class _GatheredDot(torch.autograd.Function):
    """`gathered_dot`, traced as one node."""

    @staticmethod
    def forward(ctx: Any, step: int, queries: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        return gathered_dot(queries, table, rows)

    @staticmethod
    def symbolic(g: Any, step: int, queries: Any, table: Any, rows: Any) -> Any:
        node = g.op(f"{DOMAIN}::gathered_dot", queries, table, rows, step_i=[-1, step])
        return node.setType(queries.type().with_sizes([None] * 3))


class _GatheredWeightedSum(torch.autograd.Function):
    """`gathered_weighted_sum`, traced as one node."""

    @staticmethod
    def forward(ctx: Any, step: int, probability: Tensor, table: Tensor, rows: Tensor) -> Tensor:
        return gathered_weighted_sum(probability, table, rows)

    @staticmethod
    def symbolic(g: Any, step: int, probability: Any, table: Any, rows: Any) -> Any:
        node = g.op(f"{DOMAIN}::gathered_weighted_sum", probability, table, rows, step_i=[-1, step])
        return node.setType(table.type().with_sizes([None] * 3))
