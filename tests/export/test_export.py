"""The exported files: standard, self-describing, dynamic, and equal to the network."""

import errno
import json
import os
import shutil

import numpy as np
import onnx
import pytest
import torch
from conftest import SMALL_PRESET, run_command, small_network
from depthsplat_cases import ONE_SCALE
from idesplat.export import cli, pipeline
from idesplat.export.example_inputs import example_inputs
from idesplat.export.validation.compare import TensorError
from idesplat.model.family import ErrorQuantiles
from idesplat.model.registry import PRESETS, build
from idesplat.runtime.inference.metadata import INPUTS, OUTPUTS, read_manifest, read_metadata
from idesplat.runtime.inference.predictor import Predictor

STAGES = ["encoder", "dpbu1", "dpbu2", "dpbu3", "gaussians"]


def test_graph_is_standard_and_passes_the_checker(exported):
    fused, staged = exported
    for path in (fused, *(staged / f"{stage}.onnx" for stage in STAGES)):
        model = onnx.load(path)
        onnx.checker.check_model(model, full_check=True)
        assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 20)]
        assert {node.domain for node in model.graph.node} == {""}
        assert model.ir_version == 10
        assert not model.functions


def test_inputs_and_outputs(exported):
    graph = onnx.load(exported[0]).graph

    def shape(value):
        return [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]

    assert {value.name: shape(value) for value in graph.input} == {
        "images": ["views", 3, "height", "width"],
        "extrinsics": ["views", 4, 4],
        "intrinsics": ["views", 3, 3],
        "near": ["views"],
        "far": ["views"],
    }
    assert {value.name: shape(value) for value in graph.output} == {
        "depth": ["views", "height", "width"],
        "means": ["gaussians", 3],
        "scales": ["gaussians", 3],
        "quats": ["gaussians", 4],
        "opacities": ["gaussians"],
        "sh": ["gaussians", 9, 3],
    }
    assert [value.name for value in graph.input] == list(INPUTS)
    assert [value.name for value in graph.output] == list(OUTPUTS)


def test_description(exported, small_checkpoint):
    import hashlib

    properties = {entry.key: entry.value for entry in onnx.load(exported[0]).metadata_props}
    description = read_metadata(properties, exported[0])
    assert description.preset == SMALL_PRESET
    assert (description.near, description.far, description.sh_degree) == (0.5, 100.0, 2)
    assert (description.height, description.width, description.size_multiple) == (64, 96, 16)
    assert description.checkpoint_sha256 == hashlib.sha256(small_checkpoint.read_bytes()).hexdigest()
    assert not description.fixed_size
    assert not description.fixed_views


@pytest.mark.parametrize(("views", "height", "width"), ((2, 64, 96), (3, 128, 64), (4, 64, 64), (5, 80, 112)))
def test_one_file_serves_every_number_of_views_and_size(exported, views, height, width):
    inputs = example_inputs(views, height, width, 0.5, 100.0)
    with torch.no_grad():
        expected = small_network()(*inputs.values())
    found = Predictor(exported[0]).predict_arrays(*(inputs[name].numpy() for name in INPUTS))
    for name, value in {"depth": expected.depth, **expected.gaussians._asdict()}.items():
        ours = found.depth if name == "depth" else getattr(found.gaussians, name)
        assert ours.shape == tuple(value.shape)
        # A pixel whose projection falls on a border may see the other side, so the median is what must be small.
        assert np.median(np.abs(ours - value.numpy())) < 1e-4 * value.std()


def test_staged_folder_gives_what_the_fused_file_gives(exported):
    fused, staged = exported
    inputs = example_inputs(3, 64, 96, 0.5, 100.0)
    arrays = [inputs[name].numpy() for name in INPUTS]
    whole, parts = Predictor(fused).predict_arrays(*arrays), Predictor(staged).predict_arrays(*arrays)
    assert list(parts.seconds) == STAGES
    np.testing.assert_allclose(parts.depth, whole.depth, rtol=1e-4)
    np.testing.assert_allclose(parts.gaussians.sh, whole.gaussians.sh, atol=1e-3)


def test_manifest_names_the_networks_own_stages(exported):
    stages = read_manifest(exported[1])
    assert [stage.name for stage in stages] == STAGES
    assert [name for name, _ in small_network().named_children()] == STAGES
    for stage in stages:
        model = onnx.load(exported[1] / stage.file)
        assert [value.name for value in model.graph.input] == stage.inputs
        assert [value.name for value in model.graph.output] == stage.outputs


@pytest.mark.slow
def test_fixed_views_and_size(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "depthsplat-small-one", ONE_SCALE)
    out, checkpoint = tmp_path / "fixed.onnx", tmp_path / "depthsplat-small-one.pth"
    torch.save(build(ONE_SCALE).state_dict(), checkpoint)
    assert run_command(cli.main, checkpoint, out, "--views", 2, "--size", "64x64") == 0
    shapes = {
        value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim] for value in onnx.load(out).graph.input
    }
    assert shapes["images"] == [2, 3, 64, 64]
    predictor = Predictor(out)
    inputs = example_inputs(3, 64, 64, 0.5, 100.0)
    with pytest.raises(ValueError, match="2 views and got 3"):
        predictor.predict_arrays(*(inputs[name].numpy() for name in INPUTS[:3]))
    assert "fixed.onnx" in capsys.readouterr().out


@pytest.mark.slow
def test_a_mismatching_graph_leaves_no_file(small_checkpoint, presets, tmp_path, monkeypatch, capsys):
    mismatch = TensorError(
        "2 views", "encoder", "encoder.features_mv", ErrorQuantiles(1, 2, 3), ErrorQuantiles(1, 2, 2), 3.0
    )
    monkeypatch.setattr("idesplat.export.conversion.verify", lambda *_: iter([mismatch]))
    out, staged = tmp_path / "model.onnx", tmp_path / "staged"
    assert run_command(cli.main, small_checkpoint, out, "--staged", staged) == 1
    assert list(tmp_path.iterdir()) == []
    assert "MISMATCH" in capsys.readouterr().out


def test_verification_notices_a_wrong_graph(exported):
    """The comparison fails when the weights of one tensor differ by a tenth."""
    from idesplat.export.stages import NamedTensors, Stage
    from idesplat.export.tracing import StaticShape
    from idesplat.export.validation.compare import Exported, verify

    network = NamedTensors(small_network())
    properties = {entry.key: entry.value for entry in onnx.load(exported[0]).metadata_props}
    description = read_metadata(properties, exported[0])
    with torch.no_grad():
        network.model.dpbu1.merge.conv.weight *= 1.1
    stages = [
        (Stage(stage.name, tuple(stage.inputs), tuple(stage.outputs)), exported[1] / stage.file)
        for stage in read_manifest(exported[1])
    ]
    rows = list(verify(network, Exported(stages, staged=False), description, StaticShape()))
    assert {row.stage for row in rows if not row.passed} == {"dpbu1"}


ERRORS = {
    "missing": (["none.ckpt", "out.onnx"], "no such file"),
    "no output": (["weights.pth"], "nothing to write"),
    "wrong suffix": (["weights.pth", "out.bin"], "must end in .onnx"),
    "no folder": (["weights.pth", "weights.pth/out.onnx"], "cannot write into weights.pth"),
    "unknown preset": (["weights.pth", "out.onnx", "--preset", "nonsense"], "choose one of"),
    "does not fit": (["weights.pth", "out.onnx", "--preset", "idesplat-re10k"], "does not fit"),
    "not a checkpoint": (["text.pth", "out.onnx"], "text.pth"),
    "bad size": (["weights.pth", "out.onnx", "--size", "64"], "HEIGHTxWIDTH"),
    "size not a multiple": (["weights.pth", "out.onnx", "--size", "64x70"], "multiples of 16"),
    "staged is a file": (["weights.pth", "--staged", "text.pth"], "is a file"),
    "staged holds other files": (["weights.pth", "--staged", "."], "holds app, which"),
    "staged is a data folder": (["weights.pth", "--staged", "app"], "holds index.html, which"),
    "out is not ours": (["weights.pth", "foreign.onnx"], "idesplat did not write it"),
    "out is a folder": (["weights.pth", "folder.onnx"], "is a folder, expected a file"),
    "out is the checkpoint": (["weights.onnx", "./weights.onnx"], "would replace the checkpoint"),
    "out is in the staged folder": (["weights.pth", "new/a.onnx", "--staged", "new"], "outside it"),
    "too many pixels": (["weights.pth", "out.onnx", "--size", "8192x8192"], "more than 16,777,216 pixels"),
    "a name too long": (["weights.pth", f"{'a' * 300}.onnx"], "File name too long"),
    "links in a circle": (["weights.pth", "--staged", "circle"], "choose another name"),
    "a pipe": (["pipe.pth", "out.onnx"], "not a regular file"),
}


@pytest.mark.posix
@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_one_line(name, small_checkpoint, presets, tmp_path, monkeypatch, capsys):
    arguments, expected = ERRORS[name]
    (tmp_path / "weights.pth").write_bytes(small_checkpoint.read_bytes())
    shutil.copy(tmp_path / "weights.pth", tmp_path / "weights.onnx")
    (tmp_path / "text.pth").write_text("hello")
    (tmp_path / "foreign.onnx").write_text("not ours")
    os.mkfifo(tmp_path / "pipe.pth")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    for folder in ("folder.onnx", "app", "new"):
        (tmp_path / folder).mkdir()
    (tmp_path / "app" / "manifest.json").write_text('{"name": "app"}')
    (tmp_path / "app" / "index.html").write_text("hello")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run_command(cli.main, *arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert expected in message
    assert message.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_more_views_than_can_be_traced_are_refused(small_checkpoint, tmp_path, capsys):
    assert run_command(cli.main, small_checkpoint, tmp_path / "out.onnx", "--views", 65) == 2
    assert "64" in capsys.readouterr().err


def test_a_full_disk_is_named_and_leaves_nothing(small_checkpoint, presets, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("idesplat.export.conversion.export_graphs", full)
    assert run_command(cli.main, small_checkpoint, tmp_path / "out.onnx", "--staged", tmp_path / "staged") == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("error: ") and "No space left on device" in message
    assert list(tmp_path.iterdir()) == []


def test_metadata_of_another_layout_is_refused(tmp_path):
    content = json.dumps({"layout": 99})
    with pytest.raises(ValueError, match="layout 99, expected 1"):
        read_metadata({"idesplat": content}, tmp_path)


def test_without_pytorch_the_remedy_is_named(small_checkpoint, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pipeline, "find_spec", lambda name: None)
    assert run_command(cli.main, small_checkpoint, tmp_path / "out.onnx") == 2
    assert "pip install 'idesplat[export]'" in capsys.readouterr().err
