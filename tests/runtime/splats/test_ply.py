"""Splat files: what plyfile reads of ours, what we read of plyfile's, and what we say to files that are neither."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.formats.ply import read_ply, write_ply
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_offset
from plyfile import PlyData, PlyElement

ARRAYS = ("means", "scales", "quats", "opacities", "sh")


def some_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        scales=np.exp(rng.normal(-3, 2, (count, 3))).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, count).astype(np.float32),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def assert_equal_gaussians(ours: Gaussians, expected: Gaussians) -> None:
    for name in ("means", "quats", "sh"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(expected, name), err_msg=name)
    # A float32 logarithm or logit of up to 16 is rounded by 1e-6, and the exponential makes that relative.
    for name in ("scales", "opacities"):
        np.testing.assert_allclose(getattr(ours, name), getattr(expected, name), rtol=4e-6, err_msg=name)
    for name in ARRAYS:
        assert getattr(ours, name).dtype == np.float32
        assert getattr(ours, name).flags.c_contiguous


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [0, 1, 9000])  # 9000 is more than one block
def test_round_trip(tmp_path: Path, degree: int, count: int) -> None:
    gaussians = some_gaussians(count, degree)
    write_ply(tmp_path / "scene.ply", gaussians)
    assert_equal_gaussians(read_ply(tmp_path / "scene.ply"), gaussians)


@pytest.mark.parametrize("degree", range(4))
def test_plyfile_reads_what_we_write(tmp_path: Path, degree: int) -> None:
    gaussians = some_gaussians(7, degree)
    write_ply(tmp_path / "scene.ply", gaussians)
    file = PlyData.read(tmp_path / "scene.ply")
    assert (file.text, file.byte_order, len(file.elements)) == (False, "<", 1)
    vertex = file["vertex"]
    rest = (degree + 1) ** 2 - 1
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(3 * rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [property.name for property in vertex.properties] == names
    assert {property.val_dtype for property in vertex.properties} == {"f4"}
    assert not any(vertex[name].any() for name in ("nx", "ny", "nz"))
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(vertex[name], gaussians.means[:, axis])
    np.testing.assert_allclose(np.exp(vertex["scale_1"]), gaussians.scales[:, 1], rtol=4e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), gaussians.opacities, rtol=4e-6)
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0])
    np.testing.assert_array_equal(vertex["f_dc_2"], gaussians.sh[:, 0, 2])
    for channel in range(3):  # channel-major: all of red, then green, then blue
        for coefficient in range(rest):
            written = vertex[f"f_rest_{channel * rest + coefficient}"]
            np.testing.assert_array_equal(written, gaussians.sh[:, 1 + coefficient, channel])


def foreign_vertices(gaussians: Gaussians, rng: np.random.Generator, kind: str, extra: bool) -> np.ndarray:
    """The Gaussians as a structured array as other programs write it: another order, other properties between."""
    rest = gaussians.sh.shape[1] - 1
    values = {f"rot_{i}": gaussians.quats[:, i] for i in range(4)}
    values |= {f"scale_{i}": np.log(gaussians.scales[:, i]) for i in range(3)}
    values |= {name: gaussians.means[:, i] for i, name in enumerate("xyz")}
    values |= {f"f_dc_{i}": gaussians.sh[:, 0, i] for i in range(3)}
    values["opacity"] = np.log(gaussians.opacities / (1 - gaussians.opacities))
    for channel in range(3):
        values |= {f"f_rest_{channel * rest + k}": gaussians.sh[:, 1 + k, channel] for k in range(rest)}
    row = [(name, kind) for name in values]
    if extra:
        values |= {
            "red": np.full(len(gaussians), 200),
            "score": np.zeros(len(gaussians)),
            "id": np.arange(len(gaussians)),
        }
        row += [("red", "u1"), ("score", "f8"), ("id", "i4")]
    table = np.empty(len(gaussians), [row[i] for i in rng.permutation(len(row))])
    for name, column in values.items():
        table[name] = column
    return table


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_we_read_what_plyfile_writes(tmp_path: Path, kind: str, extra: bool, degree: int) -> None:
    gaussians = some_gaussians(11, degree)
    table = foreign_vertices(gaussians, np.random.default_rng(3), kind, extra)
    before = PlyElement.describe(np.array([(1, 2.5)] * 3, [("first", "i2"), ("second", "f8")]), "intrinsic")
    after = PlyElement.describe(np.array([([1, 2, 3],)], [("vertex_indices", "O")]), "face")
    elements = [PlyElement.describe(table, "vertex")]
    if extra:
        elements = [before, *elements, after]
    PlyData(elements, byte_order="<", comments=["made elsewhere"], obj_info=["x"]).write(tmp_path / "foreign.ply")
    assert_equal_gaussians(read_ply(tmp_path / "foreign.ply"), gaussians)


def test_header_with_windows_line_ends(tmp_path: Path) -> None:
    gaussians = some_gaussians(3, 1)
    path = tmp_path / "scene.ply"
    write_ply(path, gaussians)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(header.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    assert_equal_gaussians(read_ply(path), gaussians)


def test_opacities_and_scales_at_the_ends_stay_finite(tmp_path: Path) -> None:
    gaussians = some_gaussians(4, 0)
    gaussians.opacities[:] = 0, 1, 1e-9, 0.5
    gaussians.scales[0] = 0
    write_ply(tmp_path / "scene.ply", gaussians)
    vertex = PlyData.read(tmp_path / "scene.ply")["vertex"]
    np.testing.assert_allclose(vertex["opacity"], [-13.8155, 13.8155, -13.8155, 0], rtol=3e-3, atol=1e-6)
    assert np.isfinite(vertex["scale_0"]).all()
    back = read_ply(tmp_path / "scene.ply")
    np.testing.assert_allclose(back.opacities, gaussians.opacities, atol=1.1e-6)
    assert back.scales[0].max() < 1e-20


def test_infinite_logits_of_other_writers_are_opaque(tmp_path: Path) -> None:
    table = foreign_vertices(some_gaussians(2, 0), np.random.default_rng(0), "f4", False)
    table["opacity"] = np.inf, -np.inf
    table["scale_2"] = -np.inf
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(tmp_path / "foreign.ply")
    gaussians = read_ply(tmp_path / "foreign.ply")
    np.testing.assert_array_equal(gaussians.opacities, [1, 0])
    np.testing.assert_array_equal(gaussians.scales[:, 2], 0)


@pytest.mark.parametrize(
    ("array", "field"), [("means", "x"), ("sh", "f_dc_0"), ("quats", "rot_0"), ("opacities", "opacity")]
)
def test_a_failing_write_names_the_value_and_leaves_the_old_file(tmp_path: Path, array: str, field: str) -> None:
    path = tmp_path / "scene.ply"
    write_ply(path, some_gaussians(3, 1))
    before = path.read_bytes()
    broken = some_gaussians(9000, 1)
    getattr(broken, array)[8500, ...] = np.nan  # in the second block, when the first is already written
    with pytest.raises(InputError, match=f"{field} of Gaussian 8500 is not finite"):
        write_ply(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_values_in_the_files_own_units_are_refused(tmp_path: Path) -> None:
    logarithms, logits = some_gaussians(3, 0), some_gaussians(3, 0)
    logarithms.scales[:] = np.log(logarithms.scales)
    logits.opacities[1] = 3
    with pytest.raises(InputError, match="scales holds negative values; pass standard deviations"):
        write_ply(tmp_path / "scene.ply", logarithms)
    with pytest.raises(InputError, match=r"opacities holds values outside \[0, 1\]"):
        write_ply(tmp_path / "scene.ply", logits)
    assert not list(tmp_path.iterdir())


def test_paths_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot write .*folder"):
        write_ply(tmp_path / "none" / "scene.ply", some_gaussians(1, 0))
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match=r"cannot write .*folder\.ply"):
        write_ply(tmp_path / "folder.ply", some_gaussians(1, 0))
    with pytest.raises(InputError, match=r"folder\.ply: is a folder"):
        read_ply(tmp_path / "folder.ply")
    with pytest.raises(InputError, match=r"cannot read .*none\.ply: No such file"):
        read_ply(tmp_path / "none.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ply"]


@pytest.fixture(scope="module")
def splat_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(path, some_gaussians(5, 1))
    return path.read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"png\n", "not a .ply file"),
        (b"binary_little_endian", b"ascii", "format ascii 1.0; expected binary_little_endian"),
        (b"binary_little_endian", b"binary_big_endian", "format binary_big_endian 1.0; expected binary_little_endian"),
        (b"format binary_little_endian 1.0\n", b"", "'end_header' is not understood"),
        (b"element vertex 5\n", b"", "'property float x' is not understood"),
        (b"element vertex", b"element vortex", "no element vertex"),
        (b"vertex 5", b"vertex 6", r"cut short: 6 vertices need \d+ bytes"),
        (b"vertex 5", b"vertex 900000000000000000", "cut short: 900000000000000000 vertices"),
        (b"vertex 5", b"vertex " + b"9" * 5000, "header line 'element vertex 9"),
        (b"vertex 5", b"vertex -5", "'element vertex -5' is not understood"),
        (b"vertex 5", b"vertex many", "'element vertex many' is not understood"),
        (b"property float x\n", b"property float w\n", "element vertex has no property x; "),
        (b"float x\n", b"float y\n", "has property y twice"),
        (b"float x\n", b"int x\n", "property x is not float or double"),
        (b"float x\n", b"half x\n", "'property half x' is not understood"),
        (b"float nx\n", b"list uchar int nx\n", "vertex has a list property"),
        (b"float x\n", b"list uchar int x\n", "property x is not float or double"),
        (b"property float f_rest_8\n", b"", "8 properties f_rest_*"),
        (b"f_rest_8", b"f_rest_9", "no property f_rest_8"),
        (
            b"element vertex",
            b"element face 2\nproperty list uchar int at\nelement vertex",
            "face with lists stands before",
        ),
        (b"end_header\n", b"\n", "the header has no end|is not understood"),
    ],
)
def test_malformed_headers_are_named(tmp_path: Path, splat_bytes: bytes, old: bytes, new: bytes, message: str) -> None:
    path = tmp_path / "broken.ply"
    assert old in splat_bytes
    path.write_bytes(splat_bytes.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"ply", b"ply\n", b"ply\n" + b"comment x\n" * 200_000, b"\x00" * 100])
def test_files_that_are_not_splats(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"broken\.ply"):
        read_ply(path)


def test_every_truncation_is_refused(tmp_path: Path, splat_bytes: bytes) -> None:
    path = tmp_path / "cut.ply"
    for length in range(len(splat_bytes)):
        path.write_bytes(splat_bytes[:length])
        with pytest.raises(InputError, match=r"cut\.ply"):
            read_ply(path)


@pytest.mark.parametrize("name", ["z", "f_dc_1", "f_rest_5", "opacity", "scale_2", "rot_3"])
def test_a_value_that_is_not_a_number_is_named(tmp_path: Path, name: str) -> None:
    table = foreign_vertices(some_gaussians(9000, 1), np.random.default_rng(0), "f8", False)
    table[name][8400] = np.nan
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(tmp_path / "foreign.ply")
    with pytest.raises(InputError, match=rf"foreign\.ply: {name} of vertex 8400 is not a finite number"):
        read_ply(tmp_path / "foreign.ply")


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_mutation_gives_a_scene_or_an_input_error(tmp_path: Path, splat_bytes: bytes, data: st.DataObject) -> None:
    content = bytearray(splat_bytes)
    header_end = splat_bytes.index(b"end_header")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, header_end + 40))
        length = data.draw(st.integers(0, 12))
        content[at : at + length] = data.draw(st.binary(max_size=12) | st.sampled_from([b"\n", b" ", b"9", b"double"]))
    path = tmp_path / "mutated.ply"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            gaussians = read_ply(path)
        except InputError as error:
            assert str(path) in str(error)
            return
    for name in ARRAYS:
        assert np.isfinite(getattr(gaussians, name)).all()


def test_an_offset_behind_a_blank_line_of_the_header_is_read(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", some_gaussians(0, 0))
    content = (tmp_path / "a.ply").read_bytes()
    start, rest = content.split(b"\n", 1)
    (tmp_path / "b.ply").write_bytes(start + b"\n\ncomment offset 1 2 3\n" + rest)
    assert len(read_ply(tmp_path / "b.ply")) == 0
    np.testing.assert_array_equal(read_offset(tmp_path / "b.ply"), [1, 2, 3])
