"""The benchmark: counts, reports and failures. No assertion is on wall time."""

import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL, SMALL_PRESET, run_command
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.providers import CPU, DOCUMENTATION_ALONE, PROVIDERS, is_installed
from idesplat.runtime.inference.session import SessionConfig, open_session
from idesplat.tools.benchmark import batch, runner, training
from idesplat.tools.benchmark import cli as bench
from idesplat.tools.benchmark.batch_kills import check_kills
from idesplat.tools.benchmark.report import Row, compare, read_rows, write_rows
from idesplat.tools.benchmark.worker import (
    Failed,
    Worker,
    Workload,
    eager,
    example_arrays,
    flop_of,
    gemm,
    last_kernels,
)
from onnx import TensorProto, helper, numpy_helper
from tiny_model import write_model

USUAL = ("--sizes", "64x96", "--repeats", "2", "--threads", "1")


@pytest.fixture(scope="module")
def measured(exported, tmp_path_factory) -> tuple[Path, str]:
    """The JSON and the output of the command for the same network in one file and in stages."""
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    command = [sys.executable, "-m", "idesplat.tools.benchmark.cli", *map(str, exported), *USUAL, "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return path, done.stdout


def test_every_model_gets_a_row(measured):
    path, printed = measured
    content = json.loads(path.read_text())
    assert content["machine"]["threads"] == 1
    rows = read_rows(path)
    assert [row.model for row in rows] == ["model.onnx", "staged"]
    for row in rows:
        assert (row.preset, row.precision, row.provider) == (SMALL_PRESET, "float32", "CPU")
        assert (row.views, row.height, row.width) == (2, 64, 96)
        assert len(row.seconds) == len(row.gemm_rates) == 2
        assert row.to_roofline > 0
        assert 50e6 < row.peak_bytes < 4e9
        assert row.load_seconds > 0
        assert sum(row.operators.values()) == pytest.approx(1)
        assert sum(row.stages.values()) == pytest.approx(1)
        assert {"encoder", "dpbu1", "dpbu2", "dpbu3", "gaussians"} <= set(row.stages)
        assert "Conv" in row.operators
    for text in ("model.onnx", "staged", "/ roofline", "Conv", "dpbu3", f"wrote {path}"):
        assert text in printed


def test_the_same_network_in_stages_computes_the_same(measured):
    fused, staged = read_rows(measured[0])
    assert staged.flop == pytest.approx(fused.flop, rel=1e-3)  # small things that several stages need are done in each
    assert fused.roofline_flop == staged.roofline_flop == min(fused.flop, staged.flop)
    assert fused.depth_error is None
    assert staged.depth_error < 1e-3


def test_flop_agree_with_pytorchs_counter(measured):
    """PyTorch counts executed operators; the graph adds the resizing of position embeddings, a matmul there."""
    import torch
    from idesplat.model.idesplat.network import IDESplat
    from torch.utils.flop_counter import FlopCounterMode

    arrays = example_arrays(Workload(2, 64, 96), SMALL.near, SMALL.far)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        IDESplat(SMALL).eval()(*map(torch.from_numpy, arrays))
    assert read_rows(measured[0])[0].flop == pytest.approx(counter.get_total_flops(), rel=0.02)


def test_flop_of_operators_by_hand(tmp_path):
    rng = np.random.default_rng(0)

    def weight(name: str, *shape: int):
        return numpy_helper.from_array(rng.normal(size=shape).astype(np.float32), name)

    nodes = [
        helper.make_node("Conv", ["x", "w"], ["a"], pads=[1, 1, 1, 1], strides=[2, 2], group=2),
        helper.make_node("ConvTranspose", ["a", "v"], ["b"], strides=[2, 2]),
        helper.make_node("MatMul", ["b", "m"], ["c"]),
        helper.make_node("Flatten", ["c"], ["d"], axis=2),
        helper.make_node("Gemm", ["d", "g"], ["e"], transA=1, transB=1),
        helper.make_node("DynamicQuantizeLinear", ["e"], ["f", "step", "zero"]),
        helper.make_node("MatMulInteger", ["f", "i", "zero"], ["y"]),
    ]
    weights = [weight("w", 6, 2, 3, 3), weight("v", 6, 5, 2, 2), weight("m", 12, 7), weight("g", 9, 5)]
    weights.append(numpy_helper.from_array(np.ones((9, 4), np.int8), "i"))
    given = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 4, 10, 12])
    result = helper.make_tensor_value_info("y", TensorProto.INT32, None)
    graph = helper.make_graph(nodes, "graph", [given], [result], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    session = open_session(model.SerializeToString(), CPU, SessionConfig(1, tmp_path / "profile", optimise=False))
    (y,) = session.run(None, {"x": rng.normal(size=(1, 4, 10, 12)).astype(np.float32)})
    kernels = last_kernels(Path(session.end_profiling()))
    counted = {kernel["args"]["op_name"]: flop_of(kernel["args"]) for kernel in kernels}
    assert y.shape == (70, 4)
    assert counted == {
        "Conv": 2 * (6 * 5 * 6) * (2 * 3 * 3),
        "ConvTranspose": 2 * (6 * 5 * 6) * (5 * 2 * 2),
        "MatMul": 2 * (5 * 10 * 7) * 12,
        "Flatten": 0,
        "Gemm": 2 * (70 * 9) * 5,
        "DynamicQuantizeLinear": 0,
        "MatMulInteger": 2 * (70 * 4) * 9,
    }


def test_a_preset_runs_in_eager_pytorch():
    about, run = eager("idesplat-tiny", 1, Workload(2, 64, 64))
    assert about["load_seconds"] > 0
    assert run() is None


def test_the_gemm_reference_gives_flop_per_second():
    _, run = gemm()
    assert run() > 1e8


# ---- processes


def holding(megabytes: int) -> tuple:
    return None, lambda: len(np.ones(megabytes << 17))


def failing() -> tuple:
    raise ValueError("no such\nthing")


def dying() -> tuple:
    return None, lambda: os._exit(9)


@pytest.mark.slow
def test_each_process_has_its_own_peak_memory():
    with Worker(holding, 1) as small, Worker(holding, 300) as large:
        assert (small.run().result, large.run().result) == (1 << 17, 300 << 17)
        more = large.finish() - small.finish()
    assert 250e6 < more < 350e6


@pytest.mark.slow
def test_a_process_that_fails_says_why():
    with pytest.raises(Failed, match=r"^no such thing$"):
        Worker(failing)
    with Worker(dying) as worker, pytest.raises(Failed, match=r"ended with 9; memory may have run out"):
        worker.run()


# ---- comparing


def a_row(**changes) -> Row:
    row = Row(
        "m.onnx", "p", "float32", "CPU", 2, 64, 96, seconds=[1.0, 1.1, 1.2, 1.3], gemm_rates=[1e9] * 4, peak_bytes=1000
    )
    return replace(row, **changes)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"seconds": [1.1, 1.2, 1.3, 1.4]}, []),  # more than a twentieth, within the spread
        ({"seconds": [2.0, 2.2, 2.4, 2.6]}, ["slower"]),
        ({"seconds": [0.5, 0.5, 0.6, 0.6]}, []),
        ({"seconds": [2.0, 2.2, 2.4, 2.6], "gemm_rates": [5e8] * 4}, []),  # the machine is half as fast today
        ({"seconds": [1.0, 1.1, 1.2, 1.3], "gemm_rates": [2e9] * 4}, ["slower"]),
        ({"peak_bytes": 1040}, []),
        ({"peak_bytes": 1100}, ["more memory"]),
        ({"seconds": [9.0] * 4, "peak_bytes": 9000}, ["slower", "more memory"]),
        ({"seconds": [], "gemm_rates": [], "problem": "it crashed"}, ["can no longer be measured"]),
    ],
)
def test_regressions_are_beyond_noise(changes, expected):
    row = a_row(**changes)
    assert compare([row], [a_row()]) == [f"{row.name}: {verdict}" for verdict in expected]


def test_rows_of_one_benchmark_alone_are_named(capsys):
    both, new, old = a_row(), a_row(views=3), a_row(views=4)
    assert compare([both, new], [both, old]) == []
    warnings = capsys.readouterr().err.splitlines()
    assert [line.partition(": ")[0] for line in warnings] == [new.name, old.name]
    with pytest.raises(InputError, match="none of its rows is measured here"):
        compare([new], [old])


def test_a_small_steady_slowdown_is_within_tolerance():
    assert compare([a_row(seconds=[1.03] * 4)], [a_row(seconds=[1.0] * 4)]) == []
    assert len(compare([a_row(seconds=[1.07] * 4)], [a_row(seconds=[1.0] * 4)])) == 1


def test_rows_survive_their_file(tmp_path):
    row = a_row(eager_seconds=[2.0, 2.2, 2.4, 2.6], flop=10**9, roofline_flop=5 * 10**8)
    write_rows(tmp_path / "rows.json", {}, [row])
    (again,) = read_rows(tmp_path / "rows.json")
    assert asdict(again) == asdict(row)
    assert again.to_eager == pytest.approx(0.5)
    assert again.to_roofline == pytest.approx(2 * 1.15)


def test_the_command_compares(exported, measured, tmp_path, monkeypatch, capsys):
    """What was measured once, with an older run that was much faster, or slower."""
    monkeypatch.setattr(runner, "measure", lambda *_: read_rows(measured[0])[:1])
    older = tmp_path / "older.json"
    for factor, status in ((1e-4, 1), (1e4, 0)):
        rows = [replace(row, seconds=[time * factor for time in row.seconds]) for row in read_rows(measured[0])]
        write_rows(older, {}, rows)
        assert run_command(bench.main, exported[0], *USUAL, "--no-eager", "--compare", older) == status
        printed = capsys.readouterr()
        assert ("slower" in printed.err) == bool(status)
        assert "changes" in printed.out


# ---- ends


def test_finished_workloads_survive_an_interrupt(exported, tmp_path, monkeypatch, capsys):
    def one_and_stop(candidates, workload, settings, on_status):
        if workload.views == 4:
            raise KeyboardInterrupt
        return [a_row(views=workload.views)]

    monkeypatch.setattr(runner, "measure", one_and_stop)
    path = tmp_path / "part.json"
    arguments = (exported[0], *USUAL, "--views", "2,3,4,6", "--json", path)
    assert run_command(bench.main, *arguments) == bench.INTERRUPTED
    assert [row.views for row in read_rows(path)] == [2, 3]
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
def test_the_reason_is_printed_when_nothing_can_be_measured(exported, capsys):
    assert run_command(bench.main, exported[0], "--sizes", "64x50", "--repeats", "1", "--no-eager") == 2
    printed = capsys.readouterr().err
    assert "multiples of 16" in printed
    assert "nothing could be measured" in printed


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--views", "1"), "--views 1"),
        (("--views", "two"), "--views two"),
        (("--sizes", "large"), "HEIGHTxWIDTH"),
        (("nowhere.onnx",), "nowhere.onnx: no such model"),
        (("--json", "/proc/nowhere/bench.json"), "cannot write into /proc"),
        (("--compare", "nowhere.json"), "nowhere.json: cannot be read"),
        (("--training", "model.onnx"), "--training and MODELS: expected one of them"),
        (("--training", "--json", "bench.json"), "--training and --json: expected one of them"),
        (("--training", "--compare", "bench.json"), "--training and --compare: expected one of them"),
    ],
)
def test_invalid_input_is_one_line(arguments, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(bench.main, *arguments) == 2
    printed = capsys.readouterr().err
    assert expected in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize("content", ["", "[]", '{"version": 2, "rows": [{}]}', '{"version": 2, "rows": 1}'])
def test_files_that_are_no_benchmark_are_refused(content, tmp_path, capsys):
    (tmp_path / "old.json").write_text(content)
    assert run_command(bench.main, "--compare", tmp_path / "old.json") == 2
    assert "what --json" in capsys.readouterr().err


def test_a_json_of_an_older_layout_is_named_in_one_line(tmp_path, capsys):
    (tmp_path / "old.json").write_text('{"machine": {}, "rows": [{"model": "m.onnx", "floor_flop": 1}]}')
    assert run_command(bench.main, "--compare", tmp_path / "old.json") == 2
    printed = capsys.readouterr().err
    assert "old.json: is of an older layout" in printed
    assert printed.count("\n") == 1


def test_a_failing_training_benchmark_is_one_line():
    candidate = training.Candidate("no-such-preset", "float32", 1, 1, 1)
    with pytest.raises(InputError, match=r"no-such-preset.*: its process ended with 1 \(.*no-such-preset") as error:
        training._measure("128x128, first DPBU", candidate, 1)
    assert "\n" not in str(error.value)


def test_the_environment_is_restored(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with runner.thread_environment(3):
        assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("3", "3")
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


# ---- batches


def test_a_folder_with_results_is_not_measured_again(tmp_path, capsys):
    (tmp_path / "local-2-3").mkdir()
    assert run_command(batch.main, tmp_path, "--scenes", "3") == 2
    assert "local-2-3: results are there already" in capsys.readouterr().err


@pytest.mark.slow
def test_scenes_that_fail_without_kills_are_not_killed(tmp_path):
    (tmp_path / "scenes" / "empty").mkdir(parents=True)
    with pytest.raises(InputError, match="without kills the batch ends with status 3"):
        check_kills(tmp_path / "scenes", tmp_path / "out", moments=1, seed=0, model=write_model(tmp_path / "tiny.onnx"))


# ---- execution providers


def test_providers_are_listed_with_their_packages_and_what_was_tried(capsys):
    assert run_command(bench.main, "--list-providers") == 0
    lines = capsys.readouterr().out.splitlines()
    for provider in PROVIDERS:
        (line,) = [line for line in lines if f" {provider.name} " in line and f" {provider.package} " in line]
        assert provider.tried[:24] in line  # the rest may be on the next line
        assert "not installed" in line or is_installed(provider)
    untried = [provider.name for provider in PROVIDERS if provider.tried == DOCUMENTATION_ALONE]
    assert untried == ["CUDA", "TensorRT", "TensorRT-RTX", "DirectML", "CoreML", "MLX", "QNN"]


def test_options_of_a_provider_need_to_say_whose_they_are(capsys):
    assert run_command(bench.main, "--provider", "CPU", "--provider", "WebGPU", "--device", "0") == 2
    assert "expected one --provider, whose they are" in capsys.readouterr().err


def test_a_provider_that_is_not_there_is_a_row_with_a_reason(exported, capsys):
    assert run_command(bench.main, exported[0], "--provider", "CUDA", "--no-eager", *USUAL) == 2
    assert "pip install onnxruntime-gpu" in capsys.readouterr().err
