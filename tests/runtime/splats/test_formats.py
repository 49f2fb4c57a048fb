"""Splat files of every format: our own round trip, files that other programs wrote, and ours read by another program.

The tolerances are those of the formats: half a step of what they round to, or a step for programs that cut off.
"""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import run_command
from idesplat.runtime.cli.convert import main as convert
from idesplat.runtime.errors import InputError
from idesplat.runtime.geometry.sh import SH_0
from idesplat.runtime.rendering.rasterizer import rasterize
from idesplat.runtime.splats.axes import GLTF
from idesplat.runtime.splats.formats.ply import read_ply, write_ply
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import FORMATS, read_splats, splat_suffix, write_splats
from idesplat.runtime.system.output_names import MESH_ENDINGS, POINT_ENDINGS
from plyfile import PlyData
from splat_cases import (
    ARRAYS,
    DATA,
    NEVER_EMPTY,
    SORTED,
    Bounds,
    assert_close,
    glb,
    gzipped,
    highest_degree,
    load_truth,
    our_bounds,
    spz_header,
    without_bands,
)


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return load_truth()


# ---- our own round trip


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_what_we_write_comes_back(tmp_path: Path, truth: Gaussians, suffix: str, degree: int) -> None:
    truth = without_bands(truth, degree)
    notes = write_splats(tmp_path / f"scene{suffix}", truth)
    back = read_splats(tmp_path / f"scene{suffix}")
    assert back.sh_degree == min(degree, highest_degree(suffix))
    assert bool(notes) == (degree > highest_degree(suffix))
    assert_close(back, truth, our_bounds(suffix, truth), in_order=suffix not in SORTED)


@pytest.mark.parametrize("source", FORMATS)
def test_each_format_takes_what_each_reader_gives(tmp_path: Path, truth: Gaussians, source: str) -> None:
    write_splats(tmp_path / f"source{source}", truth)
    scene = read_splats(tmp_path / f"source{source}")
    for suffix in FORMATS:
        write_splats(tmp_path / f"scene{suffix}", scene)
        back = read_splats(tmp_path / f"scene{suffix}")
        assert_close(back, without_bands(scene, back.sh_degree), our_bounds(suffix, scene), suffix not in SORTED)


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_third_degree_and_no_gaussians(tmp_path: Path, truth: Gaussians, suffix: str) -> None:
    rng = np.random.default_rng(0)
    sh = np.concatenate([truth.sh, rng.uniform(-0.9, 0.9, (len(truth), 7, 3)).astype(np.float32)], axis=1)
    third = Gaussians(truth.means, truth.scales, truth.quats, truth.opacities, sh)
    write_splats(tmp_path / f"third{suffix}", third)
    assert_close(read_splats(tmp_path / f"third{suffix}"), third, our_bounds(suffix, third), suffix not in SORTED)
    none = Gaussians(*(getattr(third, name)[:0] for name in ARRAYS))
    if suffix in NEVER_EMPTY:
        with pytest.raises(InputError, match="there are no Gaussians"):
            write_splats(tmp_path / f"none{suffix}", none)
        return
    write_splats(tmp_path / f"none{suffix}", none)
    assert len(read_splats(tmp_path / f"none{suffix}")) == 0


@pytest.mark.parametrize("suffix", FORMATS)
def test_renderings_look_the_same(tmp_path: Path, suffix: str) -> None:
    """Orientation, position and colours survive: the renderings agree."""
    rng = np.random.default_rng(5)
    count = 400
    scene = Gaussians(
        means=rng.uniform([-1, -1, 3], [1, 1, 5], (count, 3)).astype(np.float32),
        scales=rng.uniform(0.02, 0.3, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.9, count).astype(np.float32),
        sh=rng.uniform(-0.4, 0.4, (count, (highest_degree(suffix) + 1) ** 2, 3)).astype(np.float32),
    )
    write_splats(tmp_path / f"scene{suffix}", scene)
    K = np.array([[80.0, 0, 40], [0, 80.0, 30], [0, 0, 1]])
    rendered = [
        rasterize(s.means, s.quats, s.scales, s.opacities, s.sh, np.eye(4), K, 80, 60).rgb
        for s in (scene, read_splats(tmp_path / f"scene{suffix}"))
    ]
    psnr = -10 * np.log10(np.square(rendered[0] - rendered[1]).mean() + 1e-12)
    # Half steps of 1/510 and less in colour and opacity, and of .032 in a scale: 40 dB is an rms of .01.
    assert psnr > 40
    assert np.square(rendered[0] - rendered[1][::-1]).mean() > 100 * np.square(rendered[0] - rendered[1]).mean()


# ---- the files of others


FOREIGN = {
    "scene.compressed.ply": ".compressed.ply",
    "scene.gsplat.compressed.ply": ".compressed.ply",
    "scene.splat": ".splat",
    "scene.v3.spz": ".spz",
    "scene.v4.spz": ".spz",
    "scene.glb": ".glb",
    "scene.sog": ".sog",
}


def foreign_bounds(suffix: str, truth: Gaussians) -> Bounds:
    """A step instead of half of one, since others cut off; the official .spz keeps fewer bits than it could."""
    bounds = our_bounds(suffix, truth)
    doubled = Bounds(tuple(2 * value for value in bounds.means), *(2 * value for value in bounds[1:]))
    if suffix == ".spz":
        # 12 fractional bits; SH coefficients in buckets of 8 (degree 1) and 16 (degree 2) of 256.
        return doubled._replace(means=(2.0**-13,) * 3, sh=8.5 / 128)
    return doubled


@pytest.mark.parametrize("name", FOREIGN)
def test_we_read_what_others_wrote(truth: Gaussians, name: str) -> None:
    suffix = FOREIGN[name]
    back = read_splats(DATA / name)
    assert back.sh_degree == min(2, highest_degree(suffix))
    if suffix == ".sog":  # 256 centroids of SH for 270 Gaussians, so that at least 14 share one
        order = np.linalg.norm(back.means[:, None] - truth.means[None], axis=-1).argmin(axis=1)
        off = np.abs(back.sh[:, 1:] - truth.sh[order, 1:]).max(axis=(1, 2))
        assert 14 <= (off > foreign_bounds(suffix, truth).sh).sum() <= 2 * 14
        back.sh[:, 1:] = truth.sh[order, 1:]
    in_order = suffix in (".spz", ".glb")
    assert_close(back, truth, foreign_bounds(suffix, truth), in_order)


@pytest.fixture(scope="module")
def npm_modules() -> Path:
    """The npm packages that `make setup` installs where Node.js is."""
    folder = Path(__file__).parents[2] / "npm" / "node_modules"
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip("Node.js or tests/npm/node_modules is missing (make setup)")
    return folder


def read_with_plyfile(path: Path, degree: int) -> Gaussians:
    """A .ply as plyfile reads it: none of our code."""
    vertex = PlyData.read(path)["vertex"]
    rest = (degree + 1) ** 2 - 1
    sh = np.empty((len(vertex["x"]), rest + 1, 3), np.float32)
    for channel in range(3):
        sh[:, 0, channel] = vertex[f"f_dc_{channel}"]
        for k in range(rest):
            sh[:, 1 + k, channel] = vertex[f"f_rest_{channel * rest + k}"]
    return Gaussians(
        means=np.stack([vertex[axis] for axis in "xyz"], axis=1),
        scales=np.exp(np.stack([vertex[f"scale_{axis}"] for axis in range(3)], axis=1)),
        quats=np.stack([vertex[f"rot_{part}"] for part in range(4)], axis=1),
        opacities=1 / (1 + np.exp(-vertex["opacity"])),
        sh=sh,
    )


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != ".glb"])  # which it only writes
def test_splat_transform_reads_what_we_wrote(tmp_path: Path, truth: Gaussians, npm_modules: Path, suffix: str) -> None:
    degree = min(2, highest_degree(suffix))
    write_splats(tmp_path / f"ours{suffix}", truth)
    program = npm_modules / ".bin" / "splat-transform"
    command = [program, "-q", "-w", "-g", "cpu", tmp_path / f"ours{suffix}", tmp_path / "theirs.ply"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    back = read_with_plyfile(tmp_path / "theirs.ply", degree)
    assert_close(back, truth, our_bounds(suffix, truth), in_order=suffix not in SORTED)


def test_trimesh_shows_a_glb_as_coloured_points(tmp_path: Path, truth: Gaussians) -> None:
    """As a viewer without splats does, in glTF's axes: x left, y up, z forward."""
    write_splats(tmp_path / "scene.glb", truth)
    points = trimesh.load(tmp_path / "scene.glb", force="scene").to_geometry()
    np.testing.assert_allclose(points.vertices, truth.means * [-1, -1, 1], rtol=1e-6)
    srgb = np.clip(truth.colours, 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(points.colors[:, :3] / 255, linear, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(points.colors[:, 3] / 255, truth.opacities, atol=0.5 / 255 + 1e-6)


def test_the_official_validator_accepts_a_glb(tmp_path: Path, truth: Gaussians, npm_modules: Path) -> None:
    """Khronos' own, which does not know the extension yet and therefore not the names of its attributes."""
    write_splats(tmp_path / "scene.glb", truth)
    program = (
        "require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
        ".then(report => console.log(JSON.stringify(report.issues)));"
    )
    command = ["node", "-e", program, tmp_path / "scene.glb"]
    done = subprocess.run(command, cwd=npm_modules.parent, check=True, capture_output=True, timeout=120)
    issues = json.loads(done.stdout)
    assert not issues["truncated"]
    named = {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    errors = [issue for issue in issues["messages"] if issue["severity"] <= 1]
    assert not [e for e in errors if e["code"] not in named or "KHR_gaussian_splatting" not in str(e)], errors


def test_spz_positions_are_as_fine_as_the_extent_allows(tmp_path: Path, truth: Gaussians) -> None:
    for factor in (1e-3, 1, 1e5):
        scene = Gaussians(truth.means * np.float32(factor), *(getattr(truth, name) for name in ARRAYS[1:]))
        write_splats(tmp_path / "scene.spz", scene)
        off = np.abs(read_splats(tmp_path / "scene.spz").means - scene.means).max()
        assert off <= max(1.5 * 2.0**-23 * np.abs(scene.means).max(), 2.0**-25)  # a half of it from float32
    with pytest.raises(InputError, match=r"reaches 8\.97782e\+06 units.*write a \.ply"):
        write_splats(
            tmp_path / "far.spz", Gaussians(truth.means * np.float32(1e6), *(getattr(truth, n) for n in ARRAYS[1:]))
        )
    assert not (tmp_path / "far.spz").exists()


def test_what_a_format_cannot_hold_is_said(tmp_path: Path, truth: Gaussians) -> None:
    scene = without_bands(truth, 1)
    scene.sh[3, 2, 1] = 5
    scene.scales[5, 0] = 1e-12
    scene.sh[7, 0] = 2 / SH_0
    notes = {suffix: " ".join(write_splats(tmp_path / f"scene{suffix}", scene)) for suffix in FORMATS}
    assert notes[".ply"] == ""
    assert "above degree 0 were left out" in notes[".splat"] and "3 of 810 colours outside 0 to 1" in notes[".splat"]
    for text in ("1 of 810 scales outside 4.54e-05", "1 of 2,430 SH coefficients", "3 of 810 colours"):
        assert text in notes[".spz"]
    assert "1 of 810 scales" in notes[".compressed.ply"] and "1 of 2,430 SH" in notes[".compressed.ply"]


# ---- names and the command


def test_the_longest_ending_counts() -> None:
    assert splat_suffix(Path("a/b.COMPRESSED.PLY")) == ".compressed.ply"
    assert splat_suffix(Path("a/b.c.ply")) == ".ply"
    with pytest.raises(InputError, match=r"scene\.txt: expected a file name that ends in \.ply, "):
        splat_suffix(Path("scene.txt"))


@pytest.mark.parametrize("suffix", POINT_ENDINGS)
def test_points_of_a_scene(tmp_path: Path, truth: Gaussians, suffix: str) -> None:
    path = tmp_path / f"scene{suffix}"
    assert write_splats(path, truth) == ["points only: no scales, rotations, opacities or view-dependent colour"]
    positions = (
        np.loadtxt(path)[:, :3] if suffix == ".xyz" else trimesh.load(path, force="scene").to_geometry().vertices
    )
    signs = GLTF if suffix.endswith(".glb") else (1, 1, 1)
    np.testing.assert_allclose(positions, truth.means * signs, rtol=1e-6, atol=1e-8)
    with pytest.raises(InputError, match="points and meshes hold no Gaussians"):
        read_splats(path)


def test_a_surface_is_not_made_of_gaussians(tmp_path: Path, truth: Gaussians) -> None:
    for suffix in MESH_ENDINGS:
        with pytest.raises(InputError, match="write it with idesplat infer"):
            write_splats(tmp_path / f"scene{suffix}", truth)


def test_a_compressed_ply_under_another_name(tmp_path: Path, truth: Gaussians) -> None:
    shutil.copy(DATA / "scene.compressed.ply", tmp_path / "scene.ply")
    assert len(read_splats(tmp_path / "scene.ply")) == len(truth)


def test_the_command_goes_all_the_way_round(
    tmp_path: Path, truth: Gaussians, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path("a.ply"), truth)
    for source, target in (("a.ply", "b.spz"), ("b.spz", "c.compressed.ply"), ("c.compressed.ply", "d.ply")):
        assert run_command(convert, source, target) == 0
        assert f"wrote {target}: 270 Gaussians" in capsys.readouterr().out
    bounds = [our_bounds(suffix, truth) for suffix in (".spz", ".compressed.ply")]
    total = Bounds(
        tuple(np.add(*(b.means for b in bounds))), *(sum(pair) for pair in zip(*(b[1:] for b in bounds), strict=True))
    )
    assert_close(read_ply(Path("d.ply")), truth, total, in_order=False)
    assert run_command(convert, "d.ply", "e.splat") == 0
    assert "note: SH coefficients above degree 0 were left out" in capsys.readouterr().out


def test_the_command_leaves_out_what_is_faint(
    tmp_path: Path, truth: Gaussians, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path("a.ply"), truth)
    kept = truth.opacities >= 0.3
    assert run_command(convert, "a.ply", "b.glb", "--min-opacity", "0.3") == 0
    assert (
        f"filtered: {(~kept).sum()} below the opacity threshold; {kept.sum()} Gaussians left" in capsys.readouterr().out
    )
    np.testing.assert_array_equal(read_splats(Path("b.glb")).means, truth.means[kept])
    for value, message in (("1", "--min-opacity 1: no Gaussian is left of 270"), ("nan", "--min-opacity nan")):
        assert run_command(convert, "a.ply", "c.glb", "--min-opacity", value) == 2
        assert message in capsys.readouterr().err
    assert not Path("c.glb").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.ply", "b.spz"), "none.ply"),
        (("a.ply", "b.txt"), "b.txt: expected a file name"),
        (("a.txt", "b.ply"), "a.txt: expected a splat file"),
        (("a.ply", "a.ply/b.spz"), "a.ply is not a folder"),
        (("a.ply", "a.ply"), "would replace the scene"),
        (("a.ply", "folder.spz"), "folder.spz"),
        (("folder.spz", "b.ply"), "folder.spz"),
    ],
)
def test_a_wrong_command_is_one_line_and_writes_nothing(
    tmp_path: Path,
    truth: Gaussians,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_ply(Path("a.ply"), truth)
    Path("folder.spz").mkdir()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert run_command(convert, *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message in error
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_glb_with_integers_and_strides(tmp_path: Path, truth: Gaussians) -> None:
    """The other kinds of numbers that the extension allows, interleaved, in a file written by hand."""
    fields = [("position", "<f4", 3), ("rotation", "<i2", 4), ("scale", "<u2", 3), ("opacity", "u1"), ("padding", "u1")]
    row = np.zeros(3, fields)
    row["position"] = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    row["rotation"] = [[0, 0, 0, 32767], [32767, 0, 0, 0], [0, 0, -32767, 0]]
    row["scale"] = 65535, 13107, 0
    row["opacity"] = 0, 51, 255
    colours = np.zeros((3, 3), "<f4")
    binary = row.tobytes() + colours.tobytes()
    views = [{"buffer": 0, "byteLength": row.nbytes, "byteStride": row.itemsize}]
    views += [{"buffer": 0, "byteOffset": row.nbytes, "byteLength": colours.nbytes}]
    kinds = [("position", "VEC3", 5126, False), ("rotation", "VEC4", 5122, True), ("scale", "VEC3", 5123, True)]
    kinds += [("opacity", "SCALAR", 5121, True)]
    accessors = [
        {"bufferView": 0, "byteOffset": row.dtype.fields[name][1], "type": kind, "componentType": number, "count": 3}
        | ({"normalized": True} if normalized else {})
        for name, kind, number, normalized in kinds
    ]
    accessors += [{"bufferView": 1, "type": "VEC3", "componentType": 5126, "count": 3}]
    names = ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"]
    attributes = {"POSITION": 0} | {f"KHR_gaussian_splatting:{name}": index + 1 for index, name in enumerate(names)}
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [
            {"primitives": [{"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": {}}}]}
        ],
    }
    text, length = np.array([2], "<u4").tobytes() + b"JSON{}", np.array([len(binary)], "<u4").tobytes()
    header = b"glTF" + bytes(8) + text + length + b"BIN\0"
    path = tmp_path / "scene.glb"
    path.write_bytes(glb(header + binary, lambda d: d.update(document)))
    back = read_splats(path)
    np.testing.assert_array_equal(back.means, row["position"] * [-1, -1, 1])
    np.testing.assert_allclose(back.scales, np.tile([1, 0.2, 0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(back.opacities, [0, 0.2, 1], atol=1e-6)
    np.testing.assert_allclose(back.quats, [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, -1]], atol=1e-6)


def test_spz_of_version_2(tmp_path: Path, truth: Gaussians) -> None:
    """Written here by hand: x, y and z of each rotation in 8 bits, in the axes of OpenGL."""
    quats = truth.quats * np.where(truth.quats[:, :1] < 0, -1, 1)
    turned = np.rint(truth.means * [1, -1, -1] * 4096).astype("<i4")
    parts = [
        spz_header(len(truth), version=2),
        turned.view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes(),
        np.rint(truth.opacities * 255).astype(np.uint8).tobytes(),
        np.rint((truth.sh[:, 0] * 0.15 + 0.5) * 255).astype(np.uint8).tobytes(),
        np.rint((np.log(truth.scales) + 10) * 16).astype(np.uint8).tobytes(),
        np.rint(quats[:, 1:] * [1, -1, -1] * 127.5 + 127.5).astype(np.uint8).tobytes(),
    ]
    path = tmp_path / "scene.spz"
    path.write_bytes(gzipped(b"".join(parts)))
    back = read_splats(path)
    bounds = our_bounds(".spz", truth)._replace(means=(2.0**-13,) * 3, quats=2)
    assert_close(back, without_bands(truth, 0), bounds)
    # w is what x, y and z leave, so that only they are kept to half a step.
    np.testing.assert_allclose(back.quats[:, 1:], quats[:, 1:], atol=0.5 / 127.5 + 1e-6)
