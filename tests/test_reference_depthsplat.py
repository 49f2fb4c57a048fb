"""DepthSplat against what the released encoder computed, stage by stage and as a whole.

Bilinear warping has no ties, so nothing here hangs on rounding and the whole network runs freely.
"""

from pathlib import Path

import pytest
import torch
from idesplat.model.checkpoint import fill
from idesplat.model.gaussian_adapter import WorldGaussians
from idesplat.model.networks import build
from reference_weights import draw_state_dict, read_arrays, read_meta
from test_reference import as_reference, share_within

CASES = {"depthsplat-small-2v-256x256": "depthsplat-small-re10k", "depthsplat-base-2v-256x256": "depthsplat-base-re10k"}
# The stages' tensors that a case holds, the second scale's only where there is one.
STAGES = ("features_cnn", "features_mv", "scale0.logits", "scale1.logits", "gaussian_raw")


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """Expected arrays, strides, and the network's own tensors by the same names."""
    expected, meta = read_arrays(request.param), read_meta(request.param)
    model = build(CASES[request.param]).eval()
    fill(model, draw_state_dict(request.param), Path(request.param))
    assert sum(parameter.numel() for parameter in model.parameters()) == meta["parameters"]
    logits = []
    scales = [getattr(model, name) for name in ("depth", "depth1", "depth2") if hasattr(model, name)]
    for scale in scales:
        scale.head2.register_forward_hook(lambda _module, _inputs, output: logits.append(output))
    inputs = [expected["image"] / 255] + [expected[name] for name in ("extrinsics", "intrinsics", "near", "far")]
    with torch.no_grad():
        encoded, *_, predicted = model.stages(*inputs)
    found = {"features_cnn": encoded.features_cnn, "features_mv": encoded.features_mv, "gaussian_raw": predicted.raw}
    found |= {f"scale{index}.logits": value for index, value in enumerate(logits)}
    return expected, meta, found, predicted


def test_every_stage_of_the_reference_is_compared(case):
    expected, meta, found, _ = case
    assert {name.removeprefix("stage/") for name in expected if name.startswith("stage/")} == set(found)
    assert set(found) == set(meta["stage_strides_and_full_shapes"])


@pytest.mark.parametrize("name", STAGES)
def test_stages_match(case, name):
    expected, meta, found, _ = case
    if name not in found:
        pytest.skip("this network has one scale")
    stride, shape = meta["stage_strides_and_full_shapes"][name]
    assert list(found[name].shape) == shape
    reference = expected[f"stage/{name}"]
    assert share_within(found[name][..., ::stride, ::stride], reference, 1e-3 * reference.std()) >= 0.999


def test_depth_matches(case):
    expected, _, _, predicted = case
    error = (predicted.depth - expected["depth"]).abs() / expected["depth"]
    assert (error <= 1e-3).float().mean() >= 0.999
    assert error.median() < 1e-5


@pytest.mark.parametrize("name", ("means", "covariances", "opacities", "scales", "sh"))
def test_gaussians_match(case, name):
    expected, meta, _, predicted = case
    step = meta["gaussian_stride"]
    kept = [x.unflatten(0, predicted.depth.shape)[:, ::step, ::step].flatten(0, 2) for x in predicted.gaussians]
    ours, reference = as_reference(WorldGaussians(*kept), expected)[name]
    assert share_within(ours, reference, 1e-3 * reference.std()) >= 0.999
