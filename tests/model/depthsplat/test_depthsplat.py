"""DepthSplat beyond two views: against the release at other numbers of views and strides, and as a small network.

`data/depthsplat-views` was computed by the release (commit 2dad25a) with a ViT of four blocks and random weights, each
sampled from a seed and the name that the parameter had then (`former_name`). It keeps every third pixel of depth and
matching features, every twelfth of the upsampled features.
"""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from depthsplat_cases import ONE_SCALE, SMALL
from idesplat.export.conversion import build_metadata
from idesplat.export.stages import NamedTensors
from idesplat.export.tracing import StaticShape, export_graphs
from idesplat.model.common.gather_attention import GatherAttention
from idesplat.model.common.geometry import Cameras, denormalize_intrinsics, project_candidates, sampling_points
from idesplat.model.common.layers import resize
from idesplat.model.depthsplat.cost_volume import by_gathering, by_sampling
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.inference.metadata import INPUTS
from idesplat.runtime.inference.session import open_session, run_session
from reference_weights import random_tensor

VIEWS = sorted((Path(__file__).parent.parent.parent / "data" / "depthsplat-views").glob("*.npz"))


def former_name(key):
    """The name of a parameter when the reference data was computed."""
    return re.sub(r"\.upsample(_|\d\.)", r".grow\1", key).replace(".downsample.", ".shrink2.")


@pytest.fixture(scope="module", params=VIEWS, ids=lambda path: path.stem)
def views(request):
    """The release's arrays, what our network yields of the same views, the network and its inputs."""
    with np.load(request.param) as file:
        expected = {name: torch.from_numpy(file[name]) for name in file.files}
    preset, _, size = request.param.stem.rsplit("-", 2)
    config = PRESETS[preset]
    model = build(replace(config, vit=replace(config.vit, depth=4, out_indices=(0, 1, 2, 3)))).eval()
    seed, gain = expected["seed"].item(), expected["gain"].item()
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    weights = {name: random_tensor(former_name(name), shape, seed, gain) for name, shape in shapes.items()}
    model.load_state_dict({name: torch.from_numpy(value.astype(np.float32)) for name, value in weights.items()})
    images = resize(expected["thumbnails"] / 255, *map(int, size.split("x")))
    cameras = [expected[name] for name in INPUTS[1:]]
    with torch.no_grad():
        encoded, scales = model.depth_stages(images, Cameras(*cameras))
        features = model.gaussians.upsampler(encoded, [scale.features_mv for scale in scales])
    return expected, encoded, scales, features, model, [images, *cameras]


def test_all_strides_and_scales_are_covered():
    assert len(VIEWS) == 3


@pytest.mark.parity
def test_matching_features_of_several_views(views):
    expected, encoded, *_ = views
    reference = expected["features_mv"]
    assert (encoded.features_mv[..., ::3, ::3] - reference).abs().max() < 1e-4 * reference.std()


def check_depth(depth, expected):
    error = (depth[:, ::3, ::3] - expected["depth"]).abs() / expected["depth"]
    assert error.median() < 1e-5
    assert error.max() < 1e-3


@pytest.mark.parity
def test_depth_of_several_views(views):
    expected, _, scales, *_ = views
    check_depth(1 / scales[-1].inverse_depth_full[:, 0], expected)


@pytest.mark.parity
def test_depth_of_several_views_in_onnx_runtime(views, tmp_path):
    """The graph is traced at four views and another size."""
    expected, *_, model, inputs = views
    graphs = export_graphs(
        NamedTensors(model), build_metadata(model, "", "", "", StaticShape()), StaticShape(), tmp_path
    )
    feeds = {name: value.numpy() for name, value in zip(INPUTS, inputs, strict=True)}
    check_depth(torch.from_numpy(run_session(open_session(graphs.whole), feeds)["depth"]), expected)


@pytest.mark.parity
def test_upsampled_features(views):
    expected, _, _, features, *_ = views
    reference = expected["features"]
    assert (features[..., ::12, ::12] - reference).abs().max() < 1e-4 * reference.std()


def scene(count, height, width, seed=0):
    """Views of noise by cameras that turn and move a little."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(count, 3, height, width, generator=generator)
    angle = torch.rand(count, generator=generator) * 0.2 - 0.1
    extrinsics = torch.eye(4).repeat(count, 1, 1)
    extrinsics[:, 0, 0] = extrinsics[:, 2, 2] = angle.cos()
    extrinsics[:, 0, 2], extrinsics[:, 2, 0] = angle.sin(), -angle.sin()
    extrinsics[:, :3, 3] = torch.rand(count, 3, generator=generator) * 0.5
    intrinsics = torch.tensor([[0.9, 0, 0.5], [0, 1.1, 0.45], [0, 0, 1.0]]).repeat(count, 1, 1)
    return images, extrinsics, intrinsics, torch.full((count,), 0.5), torch.full((count,), 100.0)


@pytest.mark.parametrize("config", (SMALL, ONE_SCALE), ids=("two scales", "one scale"))
@pytest.mark.parametrize(("count", "height", "width"), ((2, 32, 48), (3, 48, 32), (4, 32, 48)))
def test_any_number_of_views_and_size(config, count, height, width):
    torch.manual_seed(0)
    model = build(config)
    _, *scales, predicted = model.stages(*scene(count, height, width))
    pixels = count * height * width
    shapes = {"means": (pixels, 3), "scales": (pixels, 3), "quats": (pixels, 4), "opacities": (pixels,)}
    assert predicted.depth.shape == (count, height, width)
    assert (predicted.depth >= 0.5 - 1e-4).all() and (predicted.depth <= 100 * (1 + 1e-4)).all()
    for name, value in predicted.gaussians._asdict().items():
        assert value.shape == shapes.get(name, (pixels, 9, 3))
        assert value.isfinite().all()
    # Every scale is supervised, since the second learns nothing through where the first made it search.
    losses = [scale.inverse_depth_full.log().mean() for scale in scales]
    (sum(losses) + sum(value.mean() for value in predicted.gaussians)).backward()
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert not without
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())


def test_depth_only_network_gives_the_same_depth():
    torch.manual_seed(0)
    whole, alone = build(SMALL).eval(), build(replace(SMALL, gaussians=False)).eval()
    alone.load_state_dict({k: v for k, v in whole.state_dict().items() if not k.startswith("gaussians.")})
    inputs = scene(2, 32, 48)
    with torch.no_grad():
        torch.testing.assert_close(alone(*inputs).depth, whole(*inputs).depth)


@pytest.mark.parametrize("form", (by_sampling, partial(by_gathering, gather_attention=GatherAttention(0, 1))))
def test_every_form_of_the_cost_volume_is_grid_sample_then_correlation(form):
    """Borders included, with cameras that turn away and candidates that fall far outside."""
    count, channels, height, width = 4, 6, 9, 13
    _, extrinsics, intrinsics, _, _ = scene(count, height, width, seed=4)
    extrinsics[3, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # this one looks away from the others
    features = torch.randn(count, channels, height, width, generator=torch.Generator().manual_seed(1))
    candidates = torch.linspace(0.01, 2, 11)[None, :, None, None].expand(count, -1, height, width)
    neighbours = torch.tensor([[1, 2], [0, 3], [3, 1], [0, 2]])
    pixels = denormalize_intrinsics(intrinsics, width, height)
    found = form(features, neighbours, *sampling_points(candidates, pixels, extrinsics, neighbours))

    x, y, front = project_candidates(candidates, pixels, extrinsics, neighbours)
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    grid = torch.where(front[..., None], grid, torch.full((), 9.0))
    sources = features[neighbours].flatten(0, 1)
    warped = torch.nn.functional.grid_sample(sources, grid, align_corners=True)  # [pairs, channels, candidates, h * w]
    own = features.flatten(2).repeat_interleave(2, 0)[:, :, None]
    expected = (warped * own).sum(1)
    assert (expected != 0).float().mean() > 0.3
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
