"""Models that are not what they say: one line each, whatever is wrong with metadata, manifest, graph or results."""

import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from idesplat import InputError, Predictor
from idesplat.runtime.inference.metadata import (
    MANIFEST_NAME,
    MAX_STAGES,
    METADATA_KEY,
    StageFile,
    read_manifest,
    read_metadata,
    write_manifest,
)
from idesplat.runtime.inference.session import open_session, run_limit_s, run_session
from onnx import TensorProto, helper
from tiny_model import NETWORK, OWN, arrays, write_model


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    message = str(error.value)
    assert "\n" not in message and len(message) < 1000
    return message


def test_the_network_of_these_tests_is_one(tmp_path: Path) -> None:
    prediction = Predictor(write_model(tmp_path / "model.onnx")).predict_arrays(**arrays(), near=1, far=10)
    assert prediction.depth.shape == (2, 32, 48)
    assert len(prediction.need_gaussians()) == 2 * 32 * 48


# ---- metadata


# Without subnormal numbers: a library that another test loads may have switched them off in this process.
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_subnormal=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
HUGE = st.sampled_from((10**400, -(10**400), float("nan"), float("inf"), "\x00", "\ud800", "x" * 10_000, [[]] * 1000))


@settings(max_examples=300)
@given(field=st.sampled_from(sorted(asdict(OWN))), value=JSON | HUGE)
def test_a_field_of_metadata_is_right_or_refused(field: str, value: object) -> None:
    content = asdict(OWN) | {field: value}
    try:
        read = read_metadata({METADATA_KEY: json.dumps(content)}, Path("model.onnx"))
    except InputError as error:
        assert str(error).startswith("model.onnx: damaged metadata: ") and "\n" not in str(error)
        return
    for name, expected in asdict(OWN).items():
        found = getattr(read, name)
        if name == field:
            assert found == value and (type(found) is type(expected) or isinstance(expected, float))
        else:
            assert found == expected
    assert 0 < read.near < read.far < float("inf")


@settings(max_examples=100)
@given(content=JSON | st.text() | HUGE)
def test_metadata_of_any_kind_is_refused(content: object) -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    with pytest.raises(InputError, match="damaged metadata"):
        read_metadata({METADATA_KEY: text}, Path("model.onnx"))


BAD_METADATA = {
    "nested without end": ("[" * 500_000, "nested too deeply|not valid JSON"),
    "a longer text than any": (json.dumps(asdict(OWN) | {"more": "x" * (1 << 20)}), "characters"),
    "a number of many digits": ('{"layout": ' + "9" * 5000 + "}", "not valid JSON"),
    "NaN": (json.dumps(asdict(OWN) | {"near": float("nan")}), "NaN"),
    "a flag for a number": (json.dumps(asdict(OWN) | {"height": True}), "height is True, expected a whole number"),
    "a number for a flag": (json.dumps(asdict(OWN) | {"gaussians": 1}), "gaussians is 1, expected true or false"),
    "a string for a number": (json.dumps(asdict(OWN) | {"far": "100"}), "far is '100', expected a positive"),
    "near behind far": (json.dumps(asdict(OWN) | {"near": 200}), "near < far"),
    "one view": (json.dumps(asdict(OWN) | {"fixed_views": 1}), "fixed_views is 1"),
    "steps of zero": (json.dumps(asdict(OWN) | {"size_multiple": 0}), "size_multiple is 0"),
    "a field missing": (json.dumps({key: value for key, value in asdict(OWN).items() if key != "preset"}), "preset"),
}


@pytest.mark.parametrize("name", BAD_METADATA)
def test_damaged_metadata(name: str) -> None:
    text, expected = BAD_METADATA[name]
    with pytest.raises(InputError, match=expected) as error:
        read_metadata({METADATA_KEY: text}, Path("model.onnx"))
    one_line(error)


@pytest.mark.parametrize("name", ["preset", "depth"])
def test_names_of_a_graph_that_are_not_utf8(tmp_path: Path, name: str) -> None:
    path = write_model(tmp_path / "model.onnx")
    path.write_bytes(path.read_bytes().replace(name.encode(), b"\xff" + name[1:].encode()))
    with pytest.raises(InputError, match=r"model\.onnx: ") as error:
        Predictor(path)
    one_line(error)


# ---- manifests

STAGES = [
    StageFile("first", "first.onnx", ["images", "near"], ["first.features"]),
    StageFile("second", "second.onnx", ["first.features", "far"], ["depth"]),
]


@pytest.fixture
def staged(tmp_path: Path) -> Path:
    """A folder with a manifest and two files, which are no graphs."""
    for stage in STAGES:
        (tmp_path / stage.file).write_bytes(b"")
    write_manifest(tmp_path, STAGES)
    return tmp_path


@settings(max_examples=300)
@given(data=st.data(), value=JSON | HUGE)
def test_a_manifest_is_right_or_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, value) -> None:
    folder = tmp_path_factory.mktemp("staged")
    for stage in STAGES:
        (folder / stage.file).write_bytes(b"")
    content = {"format": "idesplat-staged", "layout": 1, "stages": [asdict(stage) for stage in STAGES]}
    where = data.draw(st.sampled_from(["format", "layout", "stages", 0, 1]))
    if isinstance(where, str):
        content[where] = value
    else:
        content["stages"][where][data.draw(st.sampled_from(sorted(asdict(STAGES[0]))))] = value
    (folder / MANIFEST_NAME).write_text(json.dumps(content))
    try:
        read = read_manifest(folder)
    except InputError as error:
        assert str(error).startswith(f"{folder / MANIFEST_NAME}: damaged manifest: ") and "\n" not in str(error)
        return
    assert [asdict(stage) for stage in read] == content["stages"]
    for stage in read:
        assert all(type(name) is str for name in (stage.name, stage.file, *stage.inputs, *stage.outputs))


def changed(**changes: object) -> dict[str, object]:
    """A manifest whose first stage is another."""
    stages = [asdict(stage) for stage in STAGES]
    return {"format": "idesplat-staged", "layout": 1, "stages": [stages[0] | changes, stages[1]]}


BAD_MANIFESTS = {
    "no format": ({**changed(), "format": None}, "format is None"),
    "another layout": ({**changed(), "layout": 2}, "layout is 2"),
    "a flag for the layout": ({**changed(), "layout": True}, "layout is True"),
    "no stages": ({**changed(), "stages": []}, "expected a list of 1 to"),
    "too many stages": ({**changed(), "stages": [asdict(STAGES[0])] * (MAX_STAGES + 1)}, "1 to 32"),
    "a file elsewhere": (changed(file="../first.onnx"), "not in the folder"),
    "an absolute file": (changed(file="/dev/zero"), "not in the folder"),
    "a NUL in a name": (changed(file="a\x00b"), "damaged manifest"),
    "half a character in a name": (changed(file="\ud800"), "damaged manifest"),
    "two stages in one file": (changed(file="second.onnx"), "same file"),
    "two stages with one name": (changed(name="second"), "same name"),
    "an input that nobody yields": (changed(inputs=["other"]), "'first' reads 'other'"),
    "an output twice": (changed(outputs=["depth", "first.features"]), "'second' yields 'depth'"),
    "an input as output": (changed(outputs=["images", "first.features"]), "yields 'images'"),
    "names that are numbers": (changed(inputs=[1]), "inputs is"),
    "a name for the names": (changed(outputs="depth"), "outputs is"),
}


@pytest.mark.parametrize("name", BAD_MANIFESTS)
def test_damaged_manifests(staged: Path, name: str) -> None:
    content, expected = BAD_MANIFESTS[name]
    (staged / MANIFEST_NAME).write_text(json.dumps(content))
    with pytest.raises(InputError, match=expected) as error:
        Predictor(staged)
    one_line(error)


@pytest.mark.parametrize("content", (b"\xff\xfe\x00", b"[" * 500_000, b"", b"x" * (2 << 20)))
def test_a_manifest_that_is_no_json(staged: Path, content: bytes) -> None:
    (staged / MANIFEST_NAME).write_bytes(content)
    with pytest.raises(InputError, match=r"manifest\.json") as error:
        Predictor(staged)
    one_line(error)


# ---- graphs

BAD_GRAPHS = {
    "another input": (NETWORK.replace(" near", " nearest"), {}, "reads 'nearest'"),
    "an output missing": (
        NETWORK.replace(" depth,", " deep,").replace("    depth =", "    deep ="),
        {},
        "not yield depth",
    ),
    "an output in float64": (
        NETWORK.replace("float[views, height, width] depth", "double[views, height, width] depth").replace(
            "depth = Add (mean, one)", "deep = Add (mean, one)\n    depth = Cast <to = 11> (deep)"
        ),
        {},
        r"depth is a tensor\(double\)",
    ),
    "an input of another rank": (
        NETWORK.replace("float[views] near", "float[views, 1] near"),
        {},
        "near has the shape",
    ),
    "a size that is fixed": (NETWORK.replace("height, width] images", "32, 48] images"), {}, r"\[views, 3, 32, 48\]"),
    "a size that is not fixed": (
        NETWORK,
        {"fixed_size": True, "height": 32, "width": 48},
        r"expected \[any, 3, 32, 48",
    ),
    "views that are not fixed": (NETWORK, {"fixed_views": 3}, r"expected \[3, 3, any, any\]"),
    "another degree": (NETWORK, {"sh_degree": 2}, r"sh has the shape \[gaussians, 1, 3\], expected \[any, 9, 3\]"),
}


@pytest.mark.parametrize("name", BAD_GRAPHS)
def test_graphs_that_are_not_what_their_metadata_says(tmp_path: Path, name: str) -> None:
    text, changes, expected = BAD_GRAPHS[name]
    with pytest.raises(InputError, match=expected) as error:
        Predictor(write_model(tmp_path / "model.onnx", text, **changes))
    assert "not what its metadata says" in one_line(error)


def test_stages_that_are_not_what_the_manifest_says(exported: tuple[Path, Path], tmp_path: Path) -> None:
    """Two graphs exchanged, and a name that is in the manifest alone."""
    folder = tmp_path / "staged"
    shutil.copytree(exported[1], folder)
    stages = read_manifest(folder)
    names = [stage.file for stage in stages]
    files = [names[0], names[2], names[1], *names[3:]]
    write_manifest(folder, [StageFile(s.name, f, s.inputs, s.outputs) for s, f in zip(stages, files, strict=True)])
    with pytest.raises(InputError, match="not what its metadata says: by the") as error:
        Predictor(folder)
    one_line(error)
    last = stages[-1]
    write_manifest(folder, [*stages[:-1], StageFile(last.name, last.file, last.inputs, [*last.outputs, "more"])])
    with pytest.raises(InputError, match="by the manifest it yields 'more', by the graph it does not"):
        Predictor(folder)


BAD_RESULTS = {
    "NaN": (
        "depth = Add (mean, one)",
        "zero = Sub (mean, mean)\n depth = Div (zero, zero)",
        "NaN or infinity in 100 %",
    ),
    "negative depth": ("depth = Add (mean, one)", "depth = Neg (mean)", "depth from -"),
    "opacities above 1": ("opacities = Clip (opacities0)", "opacities = Exp (opacities0)", "opacities from 1"),
    "another shape": (
        "scales = Abs (means)",
        "two = Concat <axis = 0> (means, means)\n scales = Abs (two)",
        r"scales as float32 \(6144, 3\), expected float32 \(3072, 3\)",
    ),
    "shapes that do not fit": (
        "depth = Add (mean, one)",
        "many = Constant <value_floats = [1.0, 2.0, 3.0, 4.0, 5.0]> ()\n depth = Add (mean, many)",
        "ONNX Runtime cannot run the graph",
    ),
    "more memory than there is": (
        "depth = Add (mean, one)",
        "size = Constant <value_ints = [100000000000000]> ()\n much = Expand (one, size)\n"
        " sum = ReduceSum <keepdims = 1> (much)\n depth = Add (mean, sum)",
        "there is not enough memory",
    ),
}


@pytest.mark.parametrize("name", BAD_RESULTS)
def test_what_goes_wrong_while_a_graph_runs(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    old, new, expected = BAD_RESULTS[name]
    assert old in NETWORK
    predictor = Predictor(write_model(tmp_path / "model.onnx", NETWORK.replace(old, new)))
    with pytest.raises(InputError, match=expected) as error:
        predictor.predict_arrays(**arrays(), near=1, far=10)
    assert one_line(error).startswith(f"{tmp_path / 'model.onnx'}: ")
    assert capfd.readouterr().err == ""


FOREVER = """<ir_version: 10, opset_import: ["": 20]>
net (float[1] x) => (float[1] y) {
    times = Constant <value_int = 9223372036854775807> ()
    go = Constant <value = bool {1}> ()
    y = Loop (times, go, x) <body = body (int64 i, bool c, float[1] a) => (bool d, float[1] b) {
        d = Identity (c)
        b = Sqrt (a)
    }>
}"""


def test_a_graph_that_never_ends_is_ended(capfd: pytest.CaptureFixture[str]) -> None:
    session = open_session(onnx.parser.parse_model(FOREVER).SerializeToString())
    with pytest.raises(InputError, match=r"did not end within 0.2 s and was stopped; .*IDESPLAT_RUN_LIMIT"):
        run_session(session, {"x": np.ones(1, np.float32)}, limit_s=0.2)
    with pytest.raises(InputError, match="needs the input x"):
        run_session(session, {})
    assert capfd.readouterr().err == ""


def test_the_limit_is_the_environments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = NETWORK.replace(
        "depth = Add (mean, one)",
        """times = Constant <value_int = 9223372036854775807> ()
        go = Constant <value = bool {1}> ()
        depth = Loop (times, go, mean) <body = body (int64 i, bool c, float[v, h, w] a) => (bool d, float[v, h, w] b) {
            d = Identity (c)
            b = Sqrt (a)
        }>""",
    )
    predictor = Predictor(write_model(tmp_path / "model.onnx", body))
    monkeypatch.setenv("IDESPLAT_RUN_LIMIT", "0.3")
    with pytest.raises(InputError, match=r"model\.onnx: the graph did not end within 0.3 s"):
        predictor.predict_arrays(**arrays(), near=1, far=10)
    for text in ("soon", "-1", "0", "nan", "inf"):
        monkeypatch.setenv("IDESPLAT_RUN_LIMIT", text)
        with pytest.raises(InputError, match=f"IDESPLAT_RUN_LIMIT is {text}: expected the seconds"):
            run_limit_s(1)
    monkeypatch.delenv("IDESPLAT_RUN_LIMIT")
    assert run_limit_s(2 * 448 * 768) > 60 * 26.5  # what the slowest of the released networks takes


# ---- files


def external_model(path: Path, location: str) -> Path:
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    weight.external_data.add(key="location", value=location)
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in "xy")
    graph = helper.make_graph([helper.make_node("Add", ["x", "w"], ["y"])], "graph", [x], [y], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.posix
@pytest.mark.parametrize(
    ("location", "expected"),
    (
        ("../secret.bin", "outside its folder"),
        ("/dev/zero", "outside its folder"),
        ("link.bin", "outside its folder"),
        ("missing.bin", "which is no file"),
        ("pipe.bin", "which is no file"),
        ("a\x00b", "outside its folder"),
        ("x" * 200, "more than 127 bytes"),
        ("beside.bin", "not a model of this project"),  # so it was opened
    ),
)
def test_weights_outside_the_folder_are_not_read(tmp_path: Path, location: str, expected: str) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    for path in (tmp_path / "secret.bin", folder / "beside.bin"):
        np.arange(4, dtype=np.float32).tofile(path)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    os.mkfifo(folder / "pipe.bin")
    with pytest.raises(InputError, match=expected) as error:
        Predictor(external_model(folder / "model.onnx", location))
    one_line(error)


@pytest.mark.posix
def test_files_that_are_no_graphs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = write_model(tmp_path / "model.onnx").read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 2 :: 7] = b"\xff" * len(damaged[len(whole) // 2 :: 7])
    for name, content in (("empty", b""), ("cut", whole[: len(whole) // 2]), ("damaged", bytes(damaged))):
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}\.onnx: ") as error:
            Predictor(path)
        one_line(error)
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(100 << 30)
    with pytest.raises(InputError, match=r"large\.onnx: has 100 GiB, expected a graph of less than 2 GiB"):
        Predictor(tmp_path / "large.onnx")
    os.mkfifo(tmp_path / "pipe.onnx")
    with pytest.raises(InputError, match=r"pipe\.onnx: is no regular file"):
        Predictor(tmp_path / "pipe.onnx")
    assert capfd.readouterr().err == ""
