"""Verification of exports: what it compares, and that each kind of fault is caught in fused and staged graphs."""

import shutil

import numpy as np
import onnx
import pytest
import torch
from conftest import run_command, small_network
from idesplat.export import cli, conversion
from idesplat.export.example_inputs import room_inputs
from idesplat.export.stages import NamedTensors, Stage
from idesplat.export.tracing import StaticShape
from idesplat.export.validation.cases import Case, verification_cases
from idesplat.export.validation.compare import (
    FUSED,
    OWN_ERRORS,
    STAGED,
    Exported,
    TensorError,
    _own_bounds,
    compare,
    error_quantiles,
)
from idesplat.export.validation.report import print_details, print_summary
from idesplat.model.family import ErrorQuantiles
from idesplat.model.idesplat.family import IDESPLAT
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.metadata import INPUTS, read_manifest, read_metadata
from kept_traces import one_verification_case
from onnx import helper, numpy_helper

TOLERANCE = IDESPLAT.tolerances["float32"]
FAR_END = np.iinfo(np.int64).max


@pytest.fixture(scope="module")
def cases(exported):
    properties = {entry.key: entry.value for entry in onnx.load(exported[0]).metadata_props}
    description = read_metadata(properties, exported[0])
    return list(verification_cases(NamedTensors(small_network()), description, StaticShape()))


def stages_of(folder):
    return [
        (Stage(stage.name, tuple(stage.inputs), tuple(stage.outputs)), folder / stage.file)
        for stage in read_manifest(folder)
    ]


# ---- the cases


def test_cases_differ_in_what_can_hide_a_fault(cases):
    views = [case.views for case in cases]
    assert max(views) >= 4 and min(views) == 2
    sizes = [case.tensors["images"].shape[2:] for case in cases]
    assert any(height > width for height, width in sizes) and any(height < width for height, width in sizes)
    for name in ("intrinsics", "near", "far"):
        assert any(len(np.unique(case.tensors[name], axis=0)) == case.views for case in cases)
    assert len({float(case.tensors["near"][0]) for case in cases}) > 1
    neighbours = next(case.tensors["encoder.neighbours"] for case in cases if case.views >= 4)
    assert neighbours.shape[1] < max(views) - 1


def test_the_room_is_the_same_from_every_camera():
    """A point on the back wall has one colour in all views that see it."""
    inputs = room_inputs(3, 192, 256, 1.0, 100.0)
    pixels = []
    point = np.array([0.5, -2.0, 16.0, 1.0])  # on the back wall, above the spheres
    for pose, k, image in zip(
        inputs["extrinsics"].numpy(), inputs["intrinsics"].numpy(), inputs["images"], strict=True
    ):
        x, y, z = k @ (np.linalg.inv(pose.astype(np.float64)) @ point)[:3]
        pixels.append(image[:, int(y / z * 192), int(x / z * 256)].numpy())
    assert np.ptp(pixels, axis=0).max() < 0.06
    assert inputs["images"].std() > 0.1
    steps = inputs["images"] * 255
    torch.testing.assert_close(steps, steps.round(), atol=1e-4, rtol=0)


# ---- faults, put into the files of a sound export


class Surgery:
    """A graph whose output or input is replaced by something computed from it."""

    def __init__(self, path):
        self.path, self.model = path, onnx.load(path)
        self.nodes, self.count = [], 0
        self.prefix = f"fault.{len(self.model.graph.node)}"  # differs from that of an earlier fault

    def add(self, operator, *inputs, **attributes):
        self.count += 1
        result = f"{self.prefix}.{self.count}"
        self.nodes.append(helper.make_node(operator, list(inputs), [result], **attributes))
        return result

    def integers(self, *values):
        self.count += 1
        name = f"{self.prefix}.{self.count}"
        self.model.graph.initializer.append(numpy_helper.from_array(np.array(values, np.int64), name))
        return name

    def number(self, value):
        self.count += 1
        name = f"{self.prefix}.{self.count}"
        self.model.graph.initializer.append(numpy_helper.from_array(np.float32(value), name))
        return name

    def part(self, name, axis, start, end):
        return self.add("Slice", name, self.integers(start), self.integers(end), self.integers(axis))

    def replace_output(self, name, make):
        for node in self.model.graph.node:
            for names in (node.input, node.output):
                names[:] = [f"sound.{name}" if entry == name else entry for entry in names]
        self.nodes.append(helper.make_node("Identity", [make(f"sound.{name}")], [name]))
        self.model.graph.node.extend(self.nodes)
        self.save()

    def replace_input(self, name, make):
        replaced = make(name)
        for node in self.model.graph.node:
            node.input[:] = [replaced if entry == name else entry for entry in node.input]
        nodes = [*self.nodes, *self.model.graph.node]
        del self.model.graph.node[:]
        self.model.graph.node.extend(nodes)
        self.save()

    def save(self):
        onnx.save(self.model, self.path)


def one_view(path):
    """The last view's depth is mirrored."""
    s = Surgery(path)

    def make(depth):
        last = s.part(depth, 0, -1, FAR_END)
        mirrored = s.add("Slice", last, s.integers(-1), s.integers(-FAR_END), s.integers(1), s.integers(-1))
        return s.add("Concat", s.part(depth, 0, 0, -1), mirrored, axis=0)

    s.replace_output("depth", make)


def one_channel(path):
    """One component of the quaternions has the wrong sign."""
    s = Surgery(path)

    def make(quats):
        wrong = s.add("Neg", s.part(quats, 1, 2, 3))
        return s.add("Concat", s.part(quats, 1, 0, 2), wrong, s.part(quats, 1, 3, 4), axis=1)

    s.replace_output("quats", make)


def sh_above_degree_0(path):
    """The last coefficient, which is small, is lost."""
    s = Surgery(path)

    def make(sh):
        lost = s.add("Mul", s.part(sh, 1, 8, 9), s.number(0))
        return s.add("Concat", s.part(sh, 1, 0, 8), lost, axis=1)

    s.replace_output("sh", make)


def transposed_axis(path):
    """Rows and columns of the depth are exchanged, under the same shape."""
    s = Surgery(path)
    s.replace_output(
        "depth", lambda depth: s.add("Reshape", s.add("Transpose", depth, perm=[0, 2, 1]), s.add("Shape", depth))
    )


def baked_in_range(path):
    """The graph computes with the trained near end, whatever it is given."""
    s = Surgery(path)
    s.replace_input("near", lambda near: s.add("Add", s.add("Mul", near, s.number(0)), s.number(0.5)))


def far_of_another_view(path):
    """All views get the first one's far end."""
    s = Surgery(path)
    s.replace_input("far", lambda far: s.add("Expand", s.part(far, 0, 0, 1), s.add("Shape", far)))


def intrinsics_of_another_view(path):
    """All views get the first one's intrinsics."""
    s = Surgery(path)
    s.replace_input("intrinsics", lambda k: s.add("Expand", s.part(k, 0, 0, 1), s.add("Shape", k)))


# Faults, the stage that a staged export has them in, and the tensor that shows each there. Those of one line are put
# into one graph, since each changes another output. The last case, upright and with cameras of each view's own, shows
# all of them.
FAULTS = (
    ("gaussians", {one_view: "depth", one_channel: "quats", sh_above_degree_0: "sh"}),
    ("gaussians", {transposed_axis: "depth"}),
    ("dpbu1", {baked_in_range: "dpbu1.inverse_depth"}),
    ("dpbu1", {far_of_another_view: "dpbu1.inverse_depth"}),
    ("gaussians", {intrinsics_of_another_view: "means"}),
)
with_faults = pytest.mark.parametrize(
    ("stage", "faults"), FAULTS, ids=["-".join(fault.__name__ for fault in faults) for _, faults in FAULTS]
)


@with_faults
def test_a_fault_in_a_fused_export_is_caught(exported, cases, stage, faults, tmp_path):
    path = shutil.copy(exported[0], tmp_path / "model.onnx")
    for fault in faults:
        fault(path)
    failed = [
        error for error in compare(Exported([], staged=False, fused=path), cases[-1:], TOLERANCE) if not error.passed
    ]
    assert {error.stage for error in failed} == {FUSED}
    shown = set(faults.values()) if stage == "gaussians" else {"depth"}
    assert shown <= {error.tensor for error in failed}


@with_faults
def test_a_fault_in_a_staged_export_is_caught_in_its_stage_and_end_to_end(exported, cases, stage, faults, tmp_path):
    folder = shutil.copytree(exported[1], tmp_path / "staged")
    for fault in faults:
        fault(folder / f"{stage}.onnx")
    failed = [error for error in compare(Exported(stages_of(folder)), cases[-1:], TOLERANCE) if not error.passed]
    assert {error.stage for error in failed} == {stage, STAGED}
    assert set(faults.values()) <= {error.tensor for error in failed}


def test_a_stage_that_is_right_by_itself_is_caught_if_it_is_not_given_what_it_reads(exported, cases):
    """Stages in the wrong order, or one too few, fail in a row even if each alone does not."""
    stages = stages_of(exported[1])
    with pytest.raises(InputError, match="dpbu2"):
        list(compare(Exported([*stages[:2], *stages[3:]]), cases[1:2], TOLERANCE))


def test_a_sound_export_passes_by_far(exported, cases):
    errors = list(compare(Exported(stages_of(exported[1]), True, exported[0]), cases, TOLERANCE))
    assert {error.stage for error in errors} == {stage.name for stage, _ in stages_of(exported[1])} | {FUSED, STAGED}
    assert max(max(error.ratios) for error in errors) < 0.5


# ---- error quantiles


def figures(found, expected, views=2):
    return error_quantiles(np.asarray(found), np.asarray(expected), views)[0]


@pytest.fixture
def depth():
    return np.random.default_rng(0).standard_normal((4, 40, 60)).astype(np.float32)


def test_quantiles_are_those_of_the_worst_view(depth):
    found = depth.copy()
    found[2] += 3 * depth.std()
    assert figures(found, depth, 4) == pytest.approx((3, 3, 3), rel=1e-3)


def test_percentiles_see_a_border_that_the_median_does_not(depth):
    found = depth.copy()
    found[0, 0] += 1  # 1 row of 40
    assert figures(found, depth, 4).median == 0
    assert figures(found, depth, 4).percentile_99 > 0.9
    found = depth.copy()
    found[0, 0, :6] += 1  # 6 pixels of 2400
    assert figures(found, depth, 4)[:2] == (0, 0)
    assert figures(found, depth, 4).percentile_99_9 > 0.5


def test_a_bound_grows_with_what_rounding_changes_in_the_network_itself(depth):
    """OWN_ERRORS times its own error, if that is more than the bound, and never more than the bound end to end."""
    bounds, most = TOLERANCE.stage, TOLERANCE.end_to_end
    for own, median in ((0.0, bounds.median), (0.004, OWN_ERRORS * 0.004), (1.0, most.median)):
        rounded = depth + np.float32(own) * depth.std((1, 2), keepdims=True)
        case = Case("room", 4, {"depth": depth}, {"depth": rounded})
        found = _own_bounds("depth", case, bounds, TOLERANCE)
        assert found.median == pytest.approx(median, rel=0.05)
        assert all(low <= value <= high for low, value, high in zip(bounds, found, most, strict=True))


def test_single_pixels_may_jump(depth):
    found = depth.copy()
    found[0, 0, 0] += 100
    assert figures(found, depth, 4) == (0, 0, 0)


def test_a_weak_channel_does_not_hide_behind_a_strong_one():
    expected = np.random.default_rng(0).standard_normal((2 * 500, 9, 3)).astype(np.float32)
    expected[:, 8] *= 0.006
    found = expected.copy()
    found[:, 8, 1] = 0
    assert figures(found, expected, 2).median > 0.5


def test_a_channel_that_is_constant_up_to_rounding_is_measured_by_its_tensor():
    expected = np.ones(2 * 500, np.float32)
    expected[::2] -= np.float32(6e-8)
    assert figures(np.ones(2 * 500, np.float32), expected, 2).percentile_99_9 < 1e-3


def test_nan_shapes_and_indices(depth):
    nan = depth.copy()
    nan[1, 5, 5] = np.nan
    bounds = ErrorQuantiles(1.0, 1.0, 1.0)
    error = TensorError("case", "stage", "depth", figures(nan, depth, 4), bounds, np.nan)
    assert not error.passed and max(error.ratios) == np.inf
    assert figures(depth.transpose(0, 2, 1), depth, 4) == (np.inf,) * 3
    assert figures([[1, 2], [0, 1]], [[1, 2], [0, 2]], 2) == (np.inf,) * 3
    assert figures([[1, 2], [0, 2]], [[1, 2], [0, 2]], 2) == (0,) * 3


# ---- the table


ERRORS = [
    TensorError(
        "room, 2 views",
        "encoder",
        "encoder.mv",
        ErrorQuantiles(1e-6, 1e-6, 1e-6),
        ErrorQuantiles(1e-4, 1e-3, 1e-2),
        9.0,
    ),
    TensorError(
        "noise, 5 views",
        "encoder",
        "encoder.cnn",
        ErrorQuantiles(1e-6, 2e-3, 1e-6),
        ErrorQuantiles(1e-4, 1e-3, 1e-2),
        9.0,
    ),
    TensorError(
        "room, 2 views", FUSED, "depth", ErrorQuantiles(1e-6, 1e-6, 5e-3), ErrorQuantiles(1e-4, 1e-3, 1e-2), 9.0
    ),
]


def test_the_summary_has_one_line_a_stage_with_the_worst_quantile(capsys):
    print_summary(ERRORS)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert len(lines) == 2
    cells = [cell.strip() for cell in lines[0].split("│")[1:-1]]
    assert cells == ["encoder", "2", "cnn", "noise, 5 views", "99 %", "2.0e-03", "1.0e-03", "MISMATCH"]
    cells = [cell.strip() for cell in lines[1].split("│")[1:-1]]
    assert cells == [FUSED, "1", "depth", "room, 2 views", "99.9 %", "5.0e-03", "1.0e-02", "ok"]


def test_the_details_have_every_quantile_beside_its_bound(capsys):
    print_details(ERRORS)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert len(lines) == 3
    assert "2.0e-03 / 1e-03" in lines[1] and "MISMATCH" in lines[1]


# ---- the command verifies what it writes


@pytest.fixture(scope="module")
def prepared(small_checkpoint, presets, kept_traces, tmp_path_factory):
    """The small network's graphs as `export_graphs` leaves them; tracing takes most of an export."""
    from idesplat.export.tracing import export_graphs
    from idesplat.model.registry import PRESETS

    folder = tmp_path_factory.mktemp("graphs")
    model = small_network()
    assert model.config in PRESETS.values()
    return export_graphs(
        NamedTensors(model),
        conversion.build_metadata(model, "idesplat-small", "", "", StaticShape()),
        StaticShape(),
        folder,
    )


@pytest.fixture
def without_tracing(prepared, monkeypatch):
    def copy(network, description, fixed, folder, opset):
        shutil.copytree(prepared.folder, folder, dirs_exist_ok=True)
        return type(prepared)(folder, prepared.stages, prepared.nodes)

    monkeypatch.setattr("idesplat.export.conversion.export_graphs", copy)


@pytest.fixture
def one_case():
    with one_verification_case():
        yield


@pytest.mark.parametrize(("damaged", "form"), (("model.onnx", FUSED), ("gaussians.onnx", STAGED)))
def test_the_files_that_are_written_are_those_that_were_verified(
    damaged, form, small_checkpoint, without_tracing, one_case, tmp_path, monkeypatch, capsys
):
    """A component goes wrong between the traced graphs and one of the files; the graphs themselves are sound."""
    save_model = conversion.save_model

    def save_damaged(graph, out, external):
        files = save_model(graph, out, external)
        if out.name == damaged:
            one_channel(out)
        return files

    monkeypatch.setattr(conversion, "save_model", save_damaged)
    assert run_command(cli.main, small_checkpoint, tmp_path / "model.onnx", "--staged", tmp_path / "staged") == 1
    assert list(tmp_path.iterdir()) == []
    printed = capsys.readouterr().out
    assert "MISMATCH" in next(line for line in printed.splitlines() if form in line)


@pytest.mark.parametrize("damaged", ("model.onnx", "encoder.onnx"))
def test_a_weight_of_little_effect_is_compared_too(
    damaged, small_checkpoint, without_tracing, one_case, tmp_path, monkeypatch, capsys
):
    """One weight is off by a rounding step, which no output shows."""
    save_model = conversion.save_model

    def save_damaged(graph, out, external):
        files = save_model(graph, out, external)
        if out.name == damaged:
            model = onnx.load(out)
            tensor = max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))
            tensor.raw_data = bytes([tensor.raw_data[0] ^ 1]) + tensor.raw_data[1:]
            onnx.save(model, out)
        return files

    monkeypatch.setattr(conversion, "save_model", save_damaged)
    assert run_command(cli.main, small_checkpoint, tmp_path / "model.onnx", "--staged", tmp_path / "staged") == 2
    assert list(tmp_path.iterdir()) == []
    assert f"{damaged}: its weights" in capsys.readouterr().err


def test_the_whole_table_is_printed_on_request(small_checkpoint, without_tracing, one_case, tmp_path, capsys):
    assert run_command(cli.main, small_checkpoint, tmp_path / "model.onnx", "-vv") == 0
    printed, logged = capsys.readouterr()
    assert "comparing the weights" in logged
    assert printed.count("reading ") == 1 and "reading " not in logged  # each message is shown once
    assert sum(FUSED in line for line in printed.splitlines()) == 6
    assert set(INPUTS).isdisjoint(printed.split())


def test_a_case_keeps_inputs_and_all_tensors(cases):
    assert all(isinstance(case, Case) and set(INPUTS) < set(case.tensors) for case in cases)
