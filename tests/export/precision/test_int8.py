"""Convolutions in int8 compute what rounding their operands by hand does, however the graph moves its integers."""

import numpy as np
import onnx
import onnx.parser
import pytest
import torch
import torch.nn.functional as F
from idesplat.export.graph.subgraph import sort_nodes
from idesplat.export.precision.int8 import in_int8
from idesplat.runtime.inference.session import open_session, run_session

# A convolution of an odd number of channels, put together and with their border repeated; two more read its result.
GRAPH = """<ir_version: 10, opset_import: ["": 20]>
net (float[1, 5, h, w] a, float[1, 6, h, w] b)
    => (float[1, 9, h, w] once, float[1, 7, h, w] twice, float[1, 2, h, w] beside)
<float[9, 11, 3, 3] kernel1, float[9] bias1, float[7, 9, 3, 3] kernel2, float[7] bias2, float[2, 9, 3, 3] kernel3,
    int64[8] border>
{
    [both] joined = Concat <axis = 1> (a, b)
    [border] padded = Pad <mode = "edge"> (joined, border)
    [first] once = Conv (padded, kernel1, bias1)
    [second] twice = Conv <pads = [1, 1, 1, 1]> (once, kernel2, bias2)
    [third] beside = Conv <pads = [1, 1, 1, 1]> (once, kernel3)
}"""
WEIGHTS = {"kernel1": (9, 11, 3, 3), "bias1": (9,), "kernel2": (7, 9, 3, 3), "bias2": (7,), "kernel3": (2, 9, 3, 3)}


@pytest.fixture(scope="module")
def network():
    rng = np.random.default_rng(0)
    model = onnx.parser.parse_model(GRAPH)
    weights = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in WEIGHTS.items()}
    weights["border"] = np.array([0, 0, 1, 1, 0, 0, 1, 1], np.int64)
    model.graph.initializer.extend(onnx.numpy_helper.from_array(value, name) for name, value in weights.items())
    inputs = {
        "a": rng.standard_normal((1, 5, 12, 16)).astype(np.float32),
        "b": 1 + rng.random((1, 6, 12, 16)).astype(np.float32),
    }
    return model, weights, inputs


@pytest.fixture(scope="module")
def rounded(network, tmp_path_factory):
    model, _, inputs = network
    path = tmp_path_factory.mktemp("int8") / "float32.onnx"
    onnx.save(model, path)
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    made = in_int8(path, model, convolutions, [inputs])
    sort_nodes(made.graph)
    onnx.checker.check_model(made, full_check=True)
    return made


def test_it_computes_what_rounding_by_hand_does(network, rounded):
    _, weights, inputs = network
    w = {name: torch.from_numpy(value).double() for name, value in weights.items()}
    exact = run_session(open_session(network[0].SerializeToString()), inputs)
    joined = torch.cat([torch.from_numpy(inputs[name]).double() for name in "ab"], dim=1)
    padded = F.pad(_nearest(joined, joined), (1, 1, 1, 1), mode="replicate")
    first = F.conv2d(padded, _nearest_kernel(w["kernel1"]), w["bias1"])
    once = _nearest(first, torch.from_numpy(exact["once"]))
    second = F.conv2d(once, _nearest_kernel(w["kernel2"]), w["bias2"], padding=1)
    twice = _nearest(second, torch.from_numpy(exact["twice"]))
    third = F.conv2d(once, _nearest_kernel(w["kernel3"]), padding=1)
    beside = _nearest(third, torch.from_numpy(exact["beside"]))
    found = run_session(open_session(rounded.SerializeToString()), inputs)
    for name, expected in {"once": once, "twice": twice, "beside": beside}.items():
        steps = torch.from_numpy(found[name]).double().sub(expected).div(_step(torch.from_numpy(exact[name]))).abs()
        assert steps.max() < (1.01 if name == "once" else 4)  # a number half way between two steps, and what follows
        assert (steps < 0.01).double().mean() > 0.95


def test_what_only_convolutions_read_is_moved_as_integers(rounded):
    before = {name: node.op_type for node in rounded.graph.node for name in node.output}
    both = next(node for node in rounded.graph.node if node.op_type == "Concat")
    assert [before[name] for name in both.input] == ["QuantizeLinear", "QuantizeLinear"]
    border = next(node for node in rounded.graph.node if node.input[0] == both.output[0])
    assert border.op_type == "Pad"


def test_kernels_have_multiples_of_four_channels(rounded):
    kernels = [tensor for tensor in rounded.graph.initializer if len(tensor.dims) == 4]
    assert {tuple(kernel.dims[:2]) for kernel in kernels} == {(12, 12), (8, 12), (4, 12)}
    assert {kernel.data_type for kernel in kernels} == {onnx.TensorProto.INT8}


def test_what_others_read_too_is_not_moved_as_integers(tmp_path):
    """Nor what the graph yields."""
    model = onnx.parser.parse_model(
        """<ir_version: 10, opset_import: ["": 20]>
        net (float[1, 8, h, w] a) => (float[1, 16, h, w] c, float[1, 16, h, w] e)
        <float[16, 16, 3, 3] kernel>
        {
            [b] b = Concat <axis = 1> (a, a)
            [c] c = Conv <pads = [1, 1, 1, 1]> (b, kernel)
            [d] d = Concat <axis = 1> (a, a)
            [e] e = Add (b, d)
        }"""
    )
    kernel = np.random.default_rng(0).standard_normal((16, 16, 3, 3)).astype(np.float32)
    model.graph.initializer.append(onnx.numpy_helper.from_array(kernel, "kernel"))
    path = tmp_path / "float32.onnx"
    onnx.save(model, path)
    inputs = {"a": np.random.default_rng(1).standard_normal((1, 8, 6, 6)).astype(np.float32)}
    made = in_int8(path, model, [model.graph.node[1]], [inputs])
    found = run_session(open_session(made.SerializeToString()), inputs)
    np.testing.assert_array_equal(found["e"], 2 * np.concatenate([inputs["a"]] * 2, axis=1))


def _step(values: torch.Tensor) -> float:
    """Of the 256 numbers that stand for a range."""
    return (max(values.max().item(), 0) - min(values.min().item(), 0)) / 255


def _nearest(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """The nearest of those."""
    step = _step(like)
    zero = round(-min(like.min().item(), 0) / step)
    return ((values / step).round().add(zero).clamp(0, 255) - zero) * step


def _nearest_kernel(kernel: torch.Tensor) -> torch.Tensor:
    """The nearest multiples of each output channel's step."""
    steps = kernel.abs().amax((1, 2, 3), keepdim=True) / 127
    return (kernel / steps).round() * steps
