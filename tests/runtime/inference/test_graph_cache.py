"""Optimised graphs kept between runs: used when they fit, never when they do not, and never in the way."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference import graph_cache, session
from idesplat.runtime.inference.graph_cache import cache_entry
from idesplat.runtime.inference.session import open_session, run_session
from onnx import TensorProto, helper, numpy_helper

FEEDS = {"x": np.random.default_rng(0).normal(size=(1, 16, 12, 12)).astype(np.float32)}


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """An empty cache of one's own; the folder in which its entries will be."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "idesplat" / "graphs"


@pytest.fixture
def model(tmp_path) -> Path:
    """Convolutions, which ONNX Runtime optimises to what suits this CPU alone."""
    return write_model(tmp_path / "model.onnx")


def write_model(path: Path, scale: float = 1.0, **options) -> Path:
    rng = np.random.default_rng(1)
    weights = [rng.normal(size=(16, 16, 3, 3)).astype(np.float32) * scale for _ in range(2)]
    nodes = [
        helper.make_node("Conv", ["x", "w0"], ["a"], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Conv", ["b", "w1"], ["y"], pads=[1, 1, 1, 1]),
    ]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 16, "h", "w"]) for name in "xy"]
    initializers = [numpy_helper.from_array(weight, f"w{index}") for index, weight in enumerate(weights)]
    graph = helper.make_graph(nodes, "graph", values[:1], values[1:], initializers)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(made, {"kept": "yes"})
    onnx.save(made, path, **options)
    return path


def entries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*")) if cache.is_dir() else []


def opened_paths(monkeypatch) -> list[str]:
    """The files from which ONNX Runtime opens sessions from now on."""
    paths, create = [], session._create

    def record(model, options, providers):
        paths.append(str(model))
        return create(model, options, providers)

    monkeypatch.setattr(session, "_create", record)
    return paths


def plain(model: Path) -> np.ndarray:
    """What the model gives without any of this."""
    return onnxruntime.InferenceSession(str(model), providers=[session.CPU]).run(None, FEEDS)[0]


def test_the_second_session_opens_the_optimised_graph_and_gives_the_same(cache, model, monkeypatch):
    first = run_session(open_session(model), FEEDS)["y"]
    (entry,) = entries(cache)
    assert {node.op_type for node in onnx.load(entry).graph.node} != {"Conv", "Relu"}
    opened = opened_paths(monkeypatch)
    again = open_session(model)
    assert opened == [str(entry)]
    assert again.get_modelmeta().custom_metadata_map == {"kept": "yes"}
    np.testing.assert_array_equal(run_session(again, FEEDS)["y"], first)
    np.testing.assert_array_equal(first, plain(model))


def test_a_whole_network_gives_the_same_from_the_cache(cache, exported, monkeypatch):
    from idesplat.export.example_inputs import example_inputs

    feeds = {name: value.numpy() for name, value in example_inputs(2, 64, 96, 0.5, 100.0).items()}
    first = run_session(open_session(exported[0]), feeds)
    opened = opened_paths(monkeypatch)
    again = run_session(open_session(exported[0]), feeds)
    assert opened == [str(path) for path in entries(cache)]
    for name, value in first.items():
        np.testing.assert_array_equal(again[name], value)


def cut(entry: Path) -> None:
    entry.write_bytes(entry.read_bytes()[:-100])


def flip_a_bit(entry: Path) -> None:
    content = bytearray(entry.read_bytes())
    content[len(content) // 2] ^= 1
    entry.write_bytes(content)


def swap_for_another_models(entry: Path) -> None:
    """An intact entry under a name that another model's would have."""
    other = write_model(entry.parent / "other", scale=2.0)
    open_session(other)
    other.unlink()
    (foreign,) = (path for path in entries(entry.parent) if path != entry)
    foreign.replace(entry)


@pytest.mark.parametrize("damage", [cut, flip_a_bit, swap_for_another_models, lambda entry: entry.write_bytes(b"")])
def test_a_damaged_or_foreign_entry_is_made_anew(cache, model, damage, monkeypatch):
    open_session(model)
    (entry,) = entries(cache)
    whole = entry.read_bytes()
    damage(entry)
    opened = opened_paths(monkeypatch)
    np.testing.assert_array_equal(run_session(open_session(model), FEEDS)["y"], plain(model))
    assert opened == [str(model)]
    assert [path.read_bytes() for path in entries(cache)] == [whole]


def test_an_entry_that_cannot_be_loaded_is_removed(cache, model):
    """Its name proves its content, and the content is no graph."""
    cache_entry(model).put(lambda path: path.write_bytes(b"no graph"))
    assert len(entries(cache)) == 1
    np.testing.assert_array_equal(run_session(open_session(model), FEEDS)["y"], plain(model))
    assert entries(cache) == []


@pytest.mark.parametrize("below", ["a file", "a file/below"])
def test_without_a_folder_to_write_it_runs_all_the_same(model, tmp_path, below, monkeypatch):
    (tmp_path / "a file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / below))
    assert cache_entry(model) is None
    np.testing.assert_array_equal(run_session(open_session(model), FEEDS)["y"], plain(model))


def test_a_cache_that_can_only_be_read_is_used(cache, model, monkeypatch):
    open_session(model)

    def fail(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    for name in ("utime", "unlink", "replace"):
        monkeypatch.setattr(graph_cache.os, name, fail)
    opened = opened_paths(monkeypatch)
    open_session(model)
    assert opened == [str(path) for path in entries(cache)]


def test_a_write_that_fails_leaves_nothing(cache, model, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(graph_cache.CacheEntry, "_name", full)
    np.testing.assert_array_equal(run_session(open_session(model), FEEDS)["y"], plain(model))
    assert entries(cache) == []


def test_a_model_that_cannot_be_loaded_leaves_nothing(cache, tmp_path):
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(InputError, match=r"text\.onnx: ONNX Runtime cannot load it"):
        open_session(tmp_path / "text.onnx")
    assert entries(cache) == []


@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        (graph_cache, "describe_cpu", lambda: "another CPU"),
        (onnxruntime, "__version__", "99.0"),
        (graph_cache, "LAYOUT", graph_cache.LAYOUT + 1),
    ],
)
def test_what_was_made_elsewhere_is_not_used(cache, model, where, name, value, monkeypatch):
    here = cache_entry(model)
    monkeypatch.setattr(where, name, value)
    assert cache_entry(model).key != here.key


def test_a_model_that_changes_gets_an_entry_of_its_own(cache, model):
    open_session(model)
    write_model(model, scale=2.0)
    np.testing.assert_array_equal(run_session(open_session(model), FEEDS)["y"], plain(model))
    assert len(entries(cache)) == 2


def test_weights_in_other_files_are_never_stale(cache, tmp_path):
    """Their file can change while the model's own stays as it is, so nothing is kept."""
    options = {"save_as_external_data": True, "location": "weights.bin", "size_threshold": 0}
    model = write_model(tmp_path / "external.onnx", **options)
    before = run_session(open_session(model), FEEDS)["y"]
    (tmp_path / "weights.bin").unlink()
    write_model(model, scale=2.0, **options)
    np.testing.assert_allclose(run_session(open_session(model), FEEDS)["y"], 4 * before, rtol=1e-4, atol=1e-4)
    assert entries(cache) == []


def test_very_large_models_are_not_kept(cache, model, monkeypatch):
    monkeypatch.setattr(graph_cache, "MAX_MODEL_BYTES", model.stat().st_size - 1)
    assert cache_entry(model) is None


def test_the_cache_stays_small_and_keeps_what_is_used(cache, tmp_path, monkeypatch):
    models = [write_model(tmp_path / f"{scale}.onnx", scale=scale) for scale in (1.0, 2.0, 3.0)]
    for model in models[:2]:
        open_session(model)
    size = max(path.stat().st_size for path in entries(cache))
    monkeypatch.setattr(graph_cache, "MAX_CACHE_BYTES", 2 * size + 100)
    open_session(models[0])  # now the second is the one that was not used for longest
    open_session(models[2])
    kept = [cache_entry(model).get() is not None for model in models]
    assert kept == [True, False, True]


def test_sessions_opened_at_once_do_not_disturb_each_other(cache, model):
    with ThreadPoolExecutor(4) as pool:
        sessions = list(pool.map(open_session, [model] * 8))
    for opened in sessions:
        np.testing.assert_array_equal(run_session(opened, FEEDS)["y"], plain(model))
    assert len(entries(cache)) == 1
    assert entries(cache)[0] == cache_entry(model).get()


def test_a_session_keeps_to_the_cores_that_the_process_may_use(model, monkeypatch):
    """Left to itself, ONNX Runtime pins threads to the others, too."""
    monkeypatch.setattr(session.os, "cpu_count", lambda: 64)
    monkeypatch.setattr(session, "usable_cores", lambda: 3)
    assert session._options(session.DEFAULT).intra_op_num_threads == 3
    assert session._options(session.SessionConfig(threads=2)).intra_op_num_threads == 2
    monkeypatch.setattr(session, "usable_cores", lambda: 64)
    assert session._options(session.DEFAULT).intra_op_num_threads == session.AS_MANY_AS_CORES
