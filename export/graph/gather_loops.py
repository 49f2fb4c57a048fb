"""The sparse products of epipolar attention as ONNX runs them fastest: a few pixels at a time, by a Loop.

A pixel's candidates fall on some hundred rows of features. Gathered for all pixels at once they fill gigabytes, which
go through memory three times. Gathered for a few pixels they stay in a processor's cache, where a product of matrices
uses them up; a Loop does so in one node, whatever the size of the images. (A Scan is as fast, but OpenVINO refuses one
whose steps read a tensor from around it, as the table is.)
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

# With fewer numbers than this to gather for a pixel, the steps cost more than they save.
FEW = 256
# While a network is traced each product is one node of this domain; these functions say what it does.
DOMAIN = "idesplat"
# What both products share: rows [pairs, candidates, h * w], table [rows, channels] and `by_pixel` [pairs, h * w, ...]
# -> products [steps, step, ...], of a step's pixels, each of `shape`, with the rows that they gather. A step takes a
# block: 16 pixels in the releases' coarsest maps, where they gather most, 256 in the finest.
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
FUNCTIONS = tuple(
    f'<domain: "{DOMAIN}", opset_import: ["": 20]> {text}' for text in (GATHERED_DOT, GATHERED_WEIGHTED_SUM)
)


@contextmanager
def chunked(network: nn.Module) -> Iterator[None]:
    """Have a network's sparse products traced as nodes that `lower_custom_ops` explains."""
    parts = [part for part in network.modules() if isinstance(part, GatherAttention) and part.gathers >= FEW]
    for part in parts:
        part.gathered_dot = partial(_GatheredDot.apply, part.block)
        part.gathered_weighted_sum = partial(_GatheredWeightedSum.apply, part.block)
    try:
        yield
    finally:
        for part in parts:
            part.gathered_dot, part.gathered_weighted_sum = gathered_dot, gathered_weighted_sum


def lower_custom_ops(traced: onnx.ModelProto) -> onnx.ModelProto:
    """The graph with standard operators in place of the nodes that `chunked` left, and named after them."""
    products = {node.output[0]: node.name for node in traced.graph.node if node.domain == DOMAIN}
    traced.functions.extend(onnx.parser.parse_function(function) for function in FUNCTIONS)
    model = onnx.inliner.inline_local_functions(traced)
    name = ""
    for node in reversed(model.graph.node):  # a product's result is the last of its nodes
        name = products.get(node.output[0], name)
        if not node.name:
            _name(node, name)
    return model


def _name(node: onnx.NodeProto, scope: str) -> None:
    """Name a node, and what is inside it."""
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
