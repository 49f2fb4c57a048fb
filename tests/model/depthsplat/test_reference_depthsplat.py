"""DepthSplat against what the released encoder computed, stage by stage and as a whole, in PyTorch and ONNX Runtime.

Bilinear warping has no ties, so nothing here hangs on rounding and the whole network runs freely.
"""

from pathlib import Path

import pytest
import torch
from idesplat.export.conversion import build_metadata
from idesplat.export.stages import NamedTensors
from idesplat.export.tracing import StaticShape, export_graphs
from idesplat.model.checkpoint import fill
from idesplat.model.common.gaussian_adapter import WorldGaussians
from idesplat.model.registry import build
from idesplat.runtime.inference.session import open_session, run_session
from parity_cases import DEPTHSPLAT_CASES as CASES
from parity_cases import as_reference, share_within
from reference_weights import random_state_dict, read_arrays, read_meta

pytestmark = pytest.mark.parity

# The stages' tensors that a case holds, the second scale's only where there is one.
STAGES = ("features_cnn", "features_mv", "scale0.logits", "scale1.logits", "gaussian_raw")
GAUSSIANS = ("means", "covariances", "opacities", "scales", "sh")


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """Expected arrays, strides, and the network with the case's weights."""
    expected, meta = read_arrays(request.param), read_meta(request.param)
    model = build(CASES[request.param]).eval()
    fill(model, random_state_dict(request.param), Path(request.param))
    assert sum(parameter.numel() for parameter in model.parameters()) == meta["parameters"]
    expected["images"] = expected["image"] / 255
    return expected, meta, model


@pytest.fixture(scope="module")
def in_torch(case):
    """The network's own tensors by the reference's names, and what it predicts."""
    expected, _, model = case
    logits = []
    scales = [getattr(model, name) for name in ("depth", "depth1", "depth2") if hasattr(model, name)]
    for scale in scales:
        scale.head2.register_forward_hook(lambda _module, _inputs, output: logits.append(output))
    inputs = [expected[name] for name in ("images", "extrinsics", "intrinsics", "near", "far")]
    with torch.no_grad():
        encoded, *_, predicted = model.stages(*inputs)
    found = {"features_cnn": encoded.features_cnn, "features_mv": encoded.features_mv, "gaussian_raw": predicted.raw}
    return found | {f"scale{index}.logits": value for index, value in enumerate(logits)}, predicted


@pytest.fixture(scope="module")
def in_onnx(case, tmp_path_factory):
    """What ONNX Runtime makes of the same inputs, stage after stage, each reading what those before it yielded."""
    expected, _, model = case
    description = build_metadata(model, "reference", "random", "", StaticShape())
    graphs = export_graphs(NamedTensors(model), description, StaticShape(), tmp_path_factory.mktemp("graphs"))
    values = {name: value.numpy() for name, value in expected.items()}
    for stage in graphs.stages:
        values |= run_session(open_session(graphs.of_stage(stage)), values)
    last = graphs.stages[-2].name
    names = ("encoder.features_cnn", "encoder.features_mv", f"{last}.probability", "depth", *WorldGaussians._fields)
    return {name.removeprefix(f"{last}."): torch.from_numpy(values[name]) for name in names}


def test_every_stage_of_the_reference_is_compared(case, in_torch):
    expected, meta, _ = case
    assert {name.removeprefix("stage/") for name in expected if name.startswith("stage/")} == set(in_torch[0])
    assert set(in_torch[0]) == set(meta["stage_strides_and_full_shapes"])


@pytest.mark.parametrize("name", STAGES)
def test_stages_match(case, in_torch, name):
    expected, meta, _ = case
    if name not in in_torch[0]:
        pytest.skip("this network has one scale")
    ours = in_torch[0][name]
    stride, shape = meta["stage_strides_and_full_shapes"][name]
    assert list(ours.shape) == shape
    reference = expected[f"stage/{name}"]
    assert share_within(ours[..., ::stride, ::stride], reference, 1e-3 * reference.std()) >= 0.999


@pytest.mark.parametrize("name", ("features_cnn", "features_mv"))
def test_stages_match_in_onnx_runtime(case, in_onnx, name):
    expected, meta, _ = case
    stride, _ = meta["stage_strides_and_full_shapes"][name]
    reference = expected[f"stage/{name}"]
    ours = in_onnx[f"encoder.{name}"][..., ::stride, ::stride]
    assert share_within(ours, reference, 1e-3 * reference.std()) >= 0.999


def test_probabilities_match_in_onnx_runtime(case, in_onnx):
    expected, meta, _ = case
    name = max(name for name in expected if name.endswith(".logits"))
    stride, _ = meta["stage_strides_and_full_shapes"][name.removeprefix("stage/")]
    reference = expected[name].softmax(1)
    assert share_within(in_onnx["probability"][..., ::stride, ::stride], reference, 1e-3 * reference.std()) >= 0.999


def check_depth(depth, expected):
    error = (depth - expected["depth"]).abs() / expected["depth"]
    assert (error <= 1e-3).float().mean() >= 0.999
    assert error.median() < 1e-5


def test_depth_matches(case, in_torch):
    check_depth(in_torch[1].depth, case[0])


def test_depth_matches_in_onnx_runtime(case, in_onnx):
    check_depth(in_onnx["depth"], case[0])


def check_gaussians(gaussians, case, name):
    expected, meta, _ = case
    step, shape = meta["gaussian_stride"], expected["depth"].shape
    kept = [x.unflatten(0, shape)[:, ::step, ::step].flatten(0, 2) for x in gaussians]
    ours, reference = as_reference(WorldGaussians(*kept), expected)[name]
    assert share_within(ours, reference, 1e-3 * reference.std()) >= 0.999


@pytest.mark.parametrize("name", GAUSSIANS)
def test_gaussians_match(case, in_torch, name):
    check_gaussians(in_torch[1].gaussians, case, name)


@pytest.mark.parametrize("name", GAUSSIANS)
def test_gaussians_match_in_onnx_runtime(case, in_onnx, name):
    check_gaussians([in_onnx[field] for field in WorldGaussians._fields], case, name)
