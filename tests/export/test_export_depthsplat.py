"""DepthSplat exported: one scale, two, and depth alone, held in ONNX Runtime against PyTorch, and in use."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import trimesh
from conftest import run_command
from depthsplat_cases import ONE_SCALE, SMALL
from idesplat.export.cli import main as export
from idesplat.export.example_inputs import example_inputs
from idesplat.export.graph import external_data as weights
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.cli.infer import main as infer
from idesplat.runtime.inference.metadata import INPUTS, read_manifest
from idesplat.runtime.inference.predictor import Predictor
from reference_weights import random_tensor

SIZE = {"height": 64, "width": 96}
# With many candidates the graph scores all pixels; with few, those around each candidate.
MANY = replace(ONE_SCALE, **SIZE, scales=(replace(SMALL.scales[0], candidates=96),))
NETWORKS = {
    "depthsplat-one": MANY,
    "depthsplat-two": replace(SMALL, **SIZE),
    "depthsplat-alone": replace(SMALL, **SIZE, gaussians=False),
}
STAGES = {
    "depthsplat-one": ["encoder", "depth", "gaussians"],
    "depthsplat-two": ["encoder", "depth1", "depth2", "gaussians"],
    "depthsplat-alone": ["encoder", "depth1", "depth2"],
}


def network(name):
    """A small network with random weights as in the reference cases."""
    model = build(NETWORKS[name]).eval()
    state = {key: random_tensor(key, tuple(value.shape), seed=1, gain=1.0) for key, value in model.state_dict().items()}
    model.load_state_dict({key: torch.from_numpy(np.array(value, np.float32)) for key, value in state.items()})
    return model


@pytest.fixture(scope="module")
def graphs(kept_traces, tmp_path_factory):
    """Each network through the command: name -> fused file and staged folder; the tests compare them with PyTorch."""
    PRESETS.update(NETWORKS)
    folder = tmp_path_factory.mktemp("depthsplat")
    found = {}
    for name in NETWORKS:
        checkpoint, out, staged = folder / f"{name}.pth", folder / f"{name}.onnx", folder / name
        torch.save(network(name).state_dict(), checkpoint)
        assert run_command(export, checkpoint, out, "--staged", staged, "--no-verify") == 0
        found[name] = out, staged
    yield found
    for name in NETWORKS:
        del PRESETS[name]


def arrays(views, height, width):
    inputs = example_inputs(views, height, width, 0.5, 100.0)
    return inputs, [inputs[name].numpy() for name in INPUTS[:3]]


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("views", "height", "width"), ((2, 64, 96), (3, 64, 96), (4, 96, 64)))
def test_one_file_serves_every_number_of_views_and_size(graphs, name, views, height, width):
    inputs, given = arrays(views, height, width)
    found = Predictor(graphs[name][0]).predict_arrays(*given, near=0.5, far=100.0)
    with torch.no_grad():
        expected = network(name)(*inputs.values())
    error = np.abs(found.depth - expected.depth.numpy()) / expected.depth.numpy()
    assert (error <= 1e-3).mean() >= 0.999
    assert np.median(error) < 1e-5
    if found.gaussians is None:
        assert name == "depthsplat-alone"
        return
    for field, value in expected.gaussians._asdict().items():
        ours = getattr(found.gaussians, field)
        assert ours.shape == tuple(value.shape)
        assert (np.abs(ours - value.numpy()) <= 1e-3 * float(value.std())).mean() >= 0.999


@pytest.mark.parametrize("name", NETWORKS)
def test_stages_are_the_networks_own_and_give_the_same(graphs, name):
    fused, staged = graphs[name]
    assert [stage.name for stage in read_manifest(staged)] == STAGES[name]
    _, given = arrays(3, 64, 96)
    whole, parts = Predictor(fused).predict_arrays(*given), Predictor(staged).predict_arrays(*given)
    assert list(parts.seconds) == STAGES[name]
    np.testing.assert_allclose(parts.depth, whole.depth, rtol=1e-4)


def test_no_grid_sample_and_nothing_but_standard_operators(graphs):
    for fused, _ in graphs.values():
        model = onnx.load(fused)
        assert {node.domain for node in model.graph.node} == {""}
        assert "GridSample" not in {node.op_type for node in model.graph.node}


def test_depth_alone_is_all_that_such_a_graph_yields(graphs):
    fused, staged = graphs["depthsplat-alone"]
    for path in (fused, staged / "depth2.onnx"):
        assert [value.name for value in onnx.load(path).graph.output] == ["depth"]
    assert not Predictor(fused).metadata.gaussians
    assert Predictor(graphs["depthsplat-two"][0]).metadata.gaussians


# ---- weights beside the graph, where one file cannot hold them


def test_weights_beside_the_graph_are_found_wherever_both_are_moved(graphs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(weights, "LARGEST_FILE", 100_000)
    before, after = tmp_path / "before", tmp_path / "after"
    before.mkdir()
    checkpoint = graphs["depthsplat-alone"][0].with_suffix(".pth")
    assert run_command(export, checkpoint, before / "model.onnx", "--staged", before / "staged") == 0
    graph, beside, staged = sorted(path.name for path in before.iterdir())
    assert (graph, staged) == ("model.onnx", "staged") and re.fullmatch(r"model\.onnx\.[0-9a-f]{16}\.data", beside)
    assert f"{beside} holds the weights" in capsys.readouterr().out
    before.rename(after)
    _, given = arrays(2, 64, 96)
    expected = Predictor(graphs["depthsplat-alone"][0]).predict_arrays(*given).depth
    for model in (after / "model.onnx", after / "staged"):
        np.testing.assert_array_equal(Predictor(model).predict_arrays(*given).depth, expected)


# ---- a model that predicts depth alone, in use


@pytest.fixture
def given(graphs, scene, tmp_path, monkeypatch):
    """Arguments of idesplat-infer, from a folder of one's own."""
    monkeypatch.chdir(tmp_path)
    model = graphs["depthsplat-alone"][0]
    return ["--images", scene / "images", "--cameras", scene / "transforms.json", "--model", model]


@pytest.mark.parametrize("name", ("scene.ply", "scene.glb", "scene.points.ply", "scene.mesh.glb"))
def test_depth_alone_becomes_depth_maps_and_points_or_a_surface(given, name, capsys):
    assert run_command(infer, *given, "--out", name) == 0
    maps = sorted(Path("scene-depth").glob("*.npz"))
    assert len(maps) == len(list(Path("scene-depth").glob("*.png"))) == 2
    depth = np.stack([np.load(path)["depth"] for path in maps])
    geometry = trimesh.load(name, force="scene").to_geometry()
    assert len(geometry.vertices) == depth.size == 2 * 64 * 96
    colours = geometry.colors if "mesh" not in name else geometry.visual.vertex_colors
    assert colours[:, :3].std() > 1
    printed = capsys.readouterr().out
    assert f"wrote {name}" in printed and "wrote scene-depth: 2 depth maps" in printed
    assert f"open {name} in MeshLab" in printed and "idesplat render" not in printed


def test_depth_maps_go_where_they_are_wanted(given):
    assert run_command(infer, *given, "--out", "scene.ply", "--save-depth", "maps", "--json", "scene.json") == 0
    assert len(list(Path("maps").iterdir())) == 4
    assert sorted(path.name for path in Path().iterdir()) == ["maps", "scene.json", "scene.ply"]
    assert json.loads(Path("scene.json").read_text())["gaussians"] == 0


@pytest.mark.parametrize(
    "asked",
    (
        ("--out", "scene.spz"),
        ("--out", "scene.ply", "--render", "renders"),
        ("--out", "scene.ply", "--report", "report.html"),
        ("--out", "scene.ply", "--min-opacity", "0.1"),
    ),
    ids=lambda asked: asked[-2],
)
def test_what_needs_gaussians_is_refused_in_one_line(given, asked, capsys):
    assert run_command(infer, *given, *asked) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert asked[-2] in message and "predicts depth alone; write points or a surface (.ply, " in message
    assert not Path("scene.ply").exists()
