"""Shape arithmetic is folded and shared, groups of nodes are fused and loops unrolled, and graphs compute the same."""

import numpy as np
import onnx
import onnx.parser
import pytest
import sympy
import torch
import torch.nn.functional as F
from idesplat.export.graph.fold_shapes import declare_shapes, fold_shapes
from idesplat.export.graph.fuse import fuse_nodes
from idesplat.export.graph.symbolic_shapes import SymbolicShapes
from idesplat.export.graph.unroll import unroll_loops
from idesplat.export.graph.webgpu import pad_channels, replace_rounding
from idesplat.runtime.inference.session import open_session, run_session

VIEWS, ROWS, COLUMNS = (sympy.Symbol(name, integer=True, positive=True) for name in ("views", "rows", "columns"))
DIMS = {"x": (VIEWS, 8, 4 * ROWS, 4 * COLUMNS)}
NAMES = {ROWS: sympy.Symbol("height") / 4, COLUMNS: sympy.Symbol("width") / 4}
SIZES = ((2, 8, 12), (1, 4, 4), (3, 12, 8))
HEADER = '<ir_version: 10, opset_import: ["": 20]> net (float[views, 8, height, width] x) => '


def parse(text: str, weights: dict[str, np.ndarray] | None = None, dims=DIMS) -> tuple[onnx.ModelProto, SymbolicShapes]:
    model = onnx.parser.parse_model(HEADER + text)
    for name, value in (weights or {}).items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    known = SymbolicShapes()
    known.infer(model.graph, dims)
    return model, known


def run(model: onnx.ModelProto, size: tuple[int, int, int]) -> list[np.ndarray]:
    views, height, width = size
    x = np.random.default_rng(0).standard_normal((views, 8, height, width)).astype(np.float32)
    return list(run_session(open_session(model.SerializeToString()), {"x": x}).values())


def operators(model: onnx.ModelProto) -> list[str]:
    return [node.op_type for node in model.graph.node]


def folded(text: str) -> tuple[onnx.ModelProto, onnx.ModelProto]:
    """A graph as it is, and with its shapes folded; both compute the same at every size."""
    before, _ = parse(text)
    after, known = parse(text)
    fold_shapes(after, known, ["x"])
    declare_shapes(after, known, NAMES)
    onnx.checker.check_model(after, full_check=True)
    for size in SIZES:
        for ours, expected in zip(run(after, size), run(before, size), strict=True):
            np.testing.assert_array_equal(ours, expected)
    return before, after


TOKENS = """(float[a, b, c] y, float[d, e] z) {
    zero = Constant <value_ints = [0]> ()
    views = Shape <start = 0, end = 1> (x)
    dims = Shape (x)
    two = Constant <value = int64 {2}> ()
    three = Constant <value = int64 {3}> ()
    height = Gather (dims, two)
    width = Gather (dims, three)
    pixels0 = Mul (height, width)
    pixels = Unsqueeze (pixels0, zero)
    eight = Constant <value_ints = [8]> ()
    target = Concat <axis = 0> (views, eight, pixels)
    flat = Reshape (x, target)
    y = Transpose <perm = [0, 2, 1]> (flat)
    rows = Mul (views, pixels)
    target2 = Concat <axis = 0> (rows, eight)
    z = Reshape (y, target2)
}"""


def test_targets_of_reshapes_become_constants() -> None:
    _, after = folded(TOKENS)
    assert operators(after) == ["Reshape", "Transpose", "Reshape"]
    declared = {
        value.name: [dim.dim_param for dim in value.type.tensor_type.shape.dim] for value in after.graph.value_info
    }
    assert declared["flat"] == ["views", "", "height*width"]


def test_what_is_computed_from_a_size_is_computed_once() -> None:
    half = """
    NAMEdims = Shape (x)
    NAMEtwo = Constant <value = int64 {2}> ()
    NAMEheight = Gather (NAMEdims, NAMEtwo)
    NAMEhalf = Div (NAMEheight, NAMEtwo)
    NAMEzero = Constant <value_ints = [0]> ()
    NAMEstart = Unsqueeze (NAMEhalf, NAMEzero)
    NAMEfar = Constant <value_ints = [9223372036854775807]> ()
    NAMEaxis = Constant <value_ints = [2]> ()
    NAMEpart = Slice (x, NAMEstart, NAMEfar, NAMEaxis)
    """
    first, second = half.replace("NAME", "a"), half.replace("NAME", "b")
    _, after = folded(
        f"(float[a, b, c, d] y, float[e, f, g, h] z) {{ {first} {second} y = Neg (apart) z = Abs (bpart) }}"
    )
    assert [name for name in operators(after) if name != "Constant"].count("Div") == 1


def test_a_size_that_only_the_data_knows_is_read_from_it() -> None:
    _, after = folded(
        """(float[a, b] y) {
            flat = Constant <value_ints = [-1]> ()
            values = Reshape (x, flat)
            zero = Constant <value = float {0}> ()
            positive = Greater (values, zero)
            found = Compress (values, positive)
            count = Shape (found)
            one = Constant <value_ints = [1]> ()
            target = Concat <axis = 0> (count, one)
            y = Reshape (found, target)
        }"""
    )
    assert operators(after).count("Compress") == 1


def test_a_reshape_of_what_has_no_known_shape_leaves_a_dimension_open() -> None:
    """Its result's shape is known from the result alone, which its target must not be computed from."""
    _, after = folded(
        """(float[a, b] y) {
            flat = Constant <value_ints = [-1]> ()
            values = Reshape (x, flat)
            zero = Constant <value = float {0}> ()
            all = GreaterOrEqual (values, values)
            found = Compress (values, all)
            height = Shape <start = 2, end = 3> (x)
            target = Concat <axis = 0> (height, flat)
            y = Reshape (found, target)
        }"""
    )
    assert operators(after)[-1] == "Reshape"


def test_a_resize_to_a_multiple_has_scales() -> None:
    _, after = folded(
        """(float[a, b, c, d] y) {
            start = Shape <start = 0, end = 2> (x)
            end = Shape <start = 2, end = 4> (x)
            two = Constant <value_ints = [2]> ()
            twice = Mul (end, two)
            sizes = Concat <axis = 0> (start, twice)
            y = Resize <mode = "nearest", coordinate_transformation_mode = "asymmetric", nearest_mode = "floor">
                (x, , , sizes)
        }"""
    )
    assert operators(after) == ["Resize"]


def test_only_the_nearest_are_found() -> None:
    """A slice of sorted indices is a smaller TopK."""
    _, after = folded(
        """(int64[a, b, c, d] y) {
            all = Shape <start = 3, end = 4> (x)
            values, indices = TopK (x, all)
            zero = Constant <value_ints = [0]> ()
            three = Constant <value_ints = [3]> ()
            axis = Constant <value_ints = [3]> ()
            y0 = Slice (indices, zero, three, axis)
            y = Identity (y0)
        }"""
    )
    assert "Slice" not in operators(after)


@pytest.mark.parametrize("groups", (8, 4))
def test_group_norms(groups: int) -> None:
    rng = np.random.default_rng(0)
    weights = {name: rng.standard_normal((8, 1, 1)).astype(np.float32) for name in ("scale", "bias")}
    weights |= {"ones": np.ones(groups, np.float32), "zeros": np.zeros(groups, np.float32)}
    weights["grouped"] = np.array([0, groups, -1])
    text = f"""(float[a, b, c, d] y) <float[8, 1, 1] scale, float[8, 1, 1] bias, float[{groups}] ones,
        float[{groups}] zeros, int64[3] grouped> {{
        groups = Reshape (x, grouped)
        normed = InstanceNormalization <epsilon = 1e-5> (groups, ones, zeros)
        shape = Shape (x)
        back = Reshape (normed, shape)
        scaled = Mul (back, scale)
        y = Add (scaled, bias)
    }}"""
    model, known = parse(text, weights)
    fuse_nodes(model, known)
    known.infer(model.graph, DIMS)
    fold_shapes(model, known, ["x"])
    assert len(model.graph.node) == (1 if groups == 8 else 4)
    for size in SIZES:
        views, height, width = size
        x = np.random.default_rng(0).standard_normal((views, 8, height, width)).astype(np.float32)
        vectors = [torch.from_numpy(weights[name].ravel()).double() for name in ("scale", "bias")]
        expected = F.group_norm(torch.from_numpy(x).double(), groups, *vectors)
        np.testing.assert_allclose(run(model, size)[0], expected.numpy(), atol=1e-5)


LOOP = """(float[steps, p, a, b] products) <float[10, 6] table> {
    first = Constant <value_ints = [0]> ()
    flat = Constant <value_ints = [-1, 4, 2]> ()
    clipped = Clip (x)
    whole = Abs (clipped)
    small = Floor (whole)
    rows64 = Cast <to = 7> (small)
    rows_by_step = Reshape (rows64, flat)
    wide = Constant <value_ints = [-1, 4, 1, 2]> ()
    by_step = Reshape (x, wide)
    steps_shape = Shape <start = 0, end = 1> (rows_by_step)
    steps = Squeeze (steps_shape)
    go = Constant <value = bool {1}> ()
    products = Loop <body = a_step (int64 i, bool going) => (bool go_on, float[p, a, b] product) {
        go_on = Identity (going)
        some_rows = Gather (rows_by_step, i)
        some = Gather (by_step, i)
        gathered = Gather (table, some_rows)
        product = MatMul (some, gathered)
    }> (steps, go)
}"""


@pytest.mark.parametrize(("limit", "gathers"), ((1 << 30, 1), (16000, 2)))
def test_loops_are_unrolled_in_as_few_chunks_as_fit(limit: int, gathers: int) -> None:
    """At 2 views of 8x12 the gathered rows fill 2 * 8 * 96 * 6 * 4 = 36,864 bytes; of 16,000 it takes four parts."""
    table = {"table": np.random.default_rng(1).standard_normal((10, 6)).astype(np.float32)}
    before, _ = parse(LOOP, table)
    after, known = parse(LOOP, table)
    unroll_loops(after, known, limit, {VIEWS: 2, ROWS: 2, COLUMNS: 3})
    onnx.checker.check_model(after, full_check=True)
    assert "Loop" not in operators(after)
    assert operators(after).count("MatMul") == {1: 1, 2: 4}[gathers]
    for size in SIZES:
        np.testing.assert_array_equal(run(after, size)[0], run(before, size)[0])


def test_rounding_is_floor_of_half_more() -> None:
    model, _ = parse("(float[a, b, c, d] y) { y = Round (x) }")
    expected = run(model, SIZES[0])
    replace_rounding(model)
    assert operators(model) == ["Add", "Floor"]
    np.testing.assert_array_equal(run(model, SIZES[0])[0], expected[0])


@pytest.mark.parametrize(("channels", "read"), ((8, 8), (6, 8), (3, 3), (5, 5)))
def test_convolutions_that_webgpu_computes_wrongly_get_channels_of_zeros(channels: int, read: int, tmp_path) -> None:
    """Multiples of three, but for three itself and multiples of four."""
    weights = {"kernel": np.random.default_rng(1).standard_normal((4, channels, 3, 3)).astype(np.float32)}
    weights |= {name: np.array([value]) for name, value in (("zero", 0), ("count", channels), ("axis", 1))}
    text = f"""(float[a, b, c, d] y)
        <float[4, {channels}, 3, 3] kernel, int64[1] zero, int64[1] count, int64[1] axis> {{
        some = Slice (x, zero, count, axis)
        y = Conv <pads = [1, 1, 1, 1]> (some, kernel)
    }}"""
    model, _ = parse(text, weights)
    expected = run(model, SIZES[0])
    pad_channels(model, tmp_path)
    kernels = [tensor for tensor in model.graph.initializer if len(tensor.dims) == 4]
    assert [tensor.dims[1] for tensor in kernels] == [read]
    np.testing.assert_allclose(run(model, SIZES[0])[0], expected[0], atol=1e-5)
