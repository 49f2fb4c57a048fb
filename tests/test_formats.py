"""Splat files of every format: our own round trip, files that other programs wrote, and ours read by another program.

The tolerances are those of the formats: half a step of what they round to, or a step for programs that cut off.
"""

import json
import shutil
import subprocess
import tracemalloc
import warnings
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from conftest import run_command
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.compressed_ply import CHUNK
from idesplat.runtime.convert import main as convert
from idesplat.runtime.errors import InputError
from idesplat.runtime.formats import FORMATS, read_scene, scene_suffix, write_scene
from idesplat.runtime.frames import GLTF, OPENGL, half_turned
from idesplat.runtime.gaussians import SH_0, Gaussians
from idesplat.runtime.morton import morton_order
from idesplat.runtime.ply import read_ply, write_ply
from idesplat.runtime.quaternions import from_smallest_three, smallest_three, unit_quaternions
from idesplat.runtime.rasterizer import rasterize
from plyfile import PlyData

DATA = Path(__file__).parent / "data" / "splats"
ARRAYS = ("means", "scales", "quats", "opacities", "sh")
SPLAT_TRANSFORM = "@playcanvas/splat-transform@2.7.1"


class Bounds(NamedTuple):
    """How far a format may move each kind of number."""

    means: tuple[float, float, float] = (0, 0, 0)
    log_scales: float = 0
    quats: float = 0
    opacities: float = 0
    colours: float = 0
    sh: float = 0  # degree 1 and above


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    with np.load(DATA / "scene.npz") as file:
        return Gaussians(**{name: file[name] for name in ARRAYS})


def box(truth: Gaussians, *steps: int) -> tuple[float, ...]:
    """Half a step of each coordinate where the scene's extent is divided into so many."""
    return tuple(np.ptp(truth.means, axis=0) / (2 * np.array(steps)))


def our_bounds(suffix: str, truth: Gaussians) -> Bounds:
    """What the module of each format promises; 1e-6 for float32."""
    # The largest part of a quaternion is the root of what the smallest leave: it is off by up to three times as much.
    smallest_three_bound = 3 * 7e-4
    match suffix:
        case ".ply":
            return Bounds(log_scales=4e-6, opacities=1e-6)
        case ".compressed.ply":
            scale_range = float(np.ptp(np.log(truth.scales), axis=0).max())
            colour_range = float(np.ptp(truth.colours, axis=0).max())
            means = box(truth, 2047, 1023, 2047)
            return Bounds(means, scale_range / 2046, smallest_three_bound, 1 / 510, colour_range / 510, 1 / 64)
        case ".splat":
            return Bounds(quats=1 / 64, opacities=1 / 510, colours=1 / 510, log_scales=1e-6)
        case ".spz":
            means = (2.0**-20,) * 3  # 9 units and the sign take 5 of 24 bits
            return Bounds(means, 1 / 32, smallest_three_bound, 1 / 510, 1 / 271, 1 / 256)
        case ".glb":
            return Bounds()
    raise AssertionError(suffix)


def assert_close(back: Gaussians, truth: Gaussians, bounds: Bounds, in_order: bool = True) -> None:
    """The same Gaussians, whatever sign their quaternions have."""
    assert len(back) == len(truth)
    if not in_order:
        distance = np.linalg.norm(back.means[:, None] - truth.means[None], axis=-1)
        order = distance.argmin(axis=1)
        assert sorted(order) == list(range(len(truth)))
        truth = Gaussians(*(getattr(truth, name)[order] for name in ARRAYS))
    for name in ARRAYS:
        assert getattr(back, name).dtype == np.float32
    rounding = 2e-6
    assert (np.abs(back.means - truth.means).max(axis=0) <= np.array(bounds.means) + rounding * 10).all()
    np.testing.assert_allclose(np.log(back.scales), np.log(truth.scales), atol=bounds.log_scales + rounding)
    assert ellipsoid_turns(back.quats, truth.quats).max() <= bounds.quats + rounding
    np.testing.assert_allclose(back.opacities, truth.opacities, atol=bounds.opacities + rounding)
    np.testing.assert_allclose(back.colours, truth.colours, atol=bounds.colours + rounding)
    if back.sh_degree:
        np.testing.assert_allclose(back.sh[:, 1:], truth.sh[:, 1:], atol=bounds.sh + rounding)


def ellipsoid_turns(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """How far rotations differ in a part of their quaternion, [n]; an ellipsoid's own half turns make no difference."""
    ours, theirs = unit_quaternions(ours), unit_quaternions(theirs)
    w, x, y, z = theirs.T
    same = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    differences = [np.abs(ours - sign * np.stack(quat, axis=1)).max(axis=1) for quat in same for sign in (1, -1)]
    return np.min(differences, axis=0)


def without_bands(gaussians: Gaussians, degree: int) -> Gaussians:
    arrays = [getattr(gaussians, name).copy() for name in ARRAYS]
    return Gaussians(*arrays[:-1], np.ascontiguousarray(arrays[-1][:, : (degree + 1) ** 2]))


def highest_degree(suffix: str) -> int:
    return 0 if suffix == ".splat" else 3


# ---- our own round trip


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_what_we_write_comes_back(tmp_path: Path, truth: Gaussians, suffix: str, degree: int) -> None:
    truth = without_bands(truth, degree)
    notes = write_scene(tmp_path / f"scene{suffix}", truth)
    back = read_scene(tmp_path / f"scene{suffix}")
    assert back.sh_degree == min(degree, highest_degree(suffix))
    assert bool(notes) == (degree > highest_degree(suffix))
    assert_close(back, truth, our_bounds(suffix, truth), in_order=suffix != ".compressed.ply")


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_third_degree_and_no_gaussians(tmp_path: Path, truth: Gaussians, suffix: str) -> None:
    rng = np.random.default_rng(0)
    sh = np.concatenate([truth.sh, rng.uniform(-0.9, 0.9, (len(truth), 7, 3)).astype(np.float32)], axis=1)
    third = Gaussians(truth.means, truth.scales, truth.quats, truth.opacities, sh)
    write_scene(tmp_path / f"third{suffix}", third)
    assert_close(read_scene(tmp_path / f"third{suffix}"), third, our_bounds(suffix, third), suffix != ".compressed.ply")
    none = Gaussians(*(getattr(third, name)[:0] for name in ARRAYS))
    if suffix == ".glb":
        with pytest.raises(InputError, match="there are no Gaussians"):
            write_scene(tmp_path / f"none{suffix}", none)
        return
    write_scene(tmp_path / f"none{suffix}", none)
    if suffix == ".splat":  # without a header there is nothing that says so
        with pytest.raises(InputError, match="0 bytes"):
            read_scene(tmp_path / f"none{suffix}")
    else:
        assert len(read_scene(tmp_path / f"none{suffix}")) == 0


@pytest.mark.parametrize("suffix", FORMATS)
def test_pictures_look_the_same(tmp_path: Path, suffix: str) -> None:
    """Upright, at the same place and in the same colours: the picture says it all."""
    rng = np.random.default_rng(5)
    count = 400
    scene = Gaussians(
        means=rng.uniform([-1, -1, 3], [1, 1, 5], (count, 3)).astype(np.float32),
        scales=rng.uniform(0.02, 0.3, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.9, count).astype(np.float32),
        sh=rng.uniform(-0.4, 0.4, (count, (highest_degree(suffix) + 1) ** 2, 3)).astype(np.float32),
    )
    write_scene(tmp_path / f"scene{suffix}", scene)
    K = np.array([[80.0, 0, 40], [0, 80.0, 30], [0, 0, 1]])
    drawn = [
        rasterize(s.means, s.quats, s.scales, s.opacities, s.sh, np.eye(4), K, 80, 60).rgb
        for s in (scene, read_scene(tmp_path / f"scene{suffix}"))
    ]
    psnr = -10 * np.log10(np.square(drawn[0] - drawn[1]).mean() + 1e-12)
    # Half steps of 1/510 and less in colour and opacity, and of .032 in a scale: 40 dB is an rms of .01.
    assert psnr > 40
    assert np.square(drawn[0] - drawn[1][::-1]).mean() > 100 * np.square(drawn[0] - drawn[1]).mean()


# ---- the files of others

FOREIGN = {
    "scene.compressed.ply": ".compressed.ply",
    "scene.gsplat.compressed.ply": ".compressed.ply",
    "scene.splat": ".splat",
    "scene.v3.spz": ".spz",
    "scene.glb": ".glb",
}


def foreign_bounds(suffix: str, truth: Gaussians) -> Bounds:
    """A step instead of half of one, since others cut off; the official .spz keeps fewer bits than it could."""
    bounds = our_bounds(suffix, truth)
    doubled = Bounds(tuple(2 * value for value in bounds.means), *(2 * value for value in bounds[1:]))
    if suffix == ".spz":
        # 12 bits behind the point; spherical harmonics in buckets of 8 (degree 1) and 16 (degree 2) of 256.
        return doubled._replace(means=(2.0**-13,) * 3, sh=8.5 / 128)
    return doubled


@pytest.mark.parametrize("name", FOREIGN)
def test_we_read_what_others_wrote(truth: Gaussians, name: str) -> None:
    suffix = FOREIGN[name]
    back = read_scene(DATA / name)
    assert back.sh_degree == min(2, highest_degree(suffix))
    in_order = suffix in (".spz", ".glb")
    assert_close(back, truth, foreign_bounds(suffix, truth), in_order)


@pytest.fixture(scope="module")
def splat_transform() -> str:
    """The command of PlayCanvas' splat-transform, which npx fetches once and keeps."""
    return run_npx(SPLAT_TRANSFORM, ["sh", "-c", "command -v splat-transform"]).split()[-1]


def run_npx(package: str, command: list[str]) -> str:
    """What a command prints where an npm package is at hand, which npx fetches once and keeps; skips without it."""
    if shutil.which("npx") is None:
        pytest.skip(f"npx (Node.js) is not installed, so {package} cannot try our files")
    fetch = ["npx", "--yes", "--package", package, "--"]
    try:
        there = subprocess.run([*fetch, "node", "--version"], capture_output=True, timeout=180, check=False, text=True)
    except subprocess.TimeoutExpired:
        pytest.skip(f"npx did not fetch {package} within three minutes")
    if there.returncode:
        pytest.skip(f"npx cannot fetch {package}: {there.stderr[-300:]}")
    return subprocess.run([*fetch, *command], capture_output=True, timeout=180, check=True, text=True).stdout


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
def test_splat_transform_reads_what_we_wrote(
    tmp_path: Path, truth: Gaussians, splat_transform: str, suffix: str
) -> None:
    degree = min(2, highest_degree(suffix))
    write_scene(tmp_path / f"ours{suffix}", truth)
    command = [splat_transform, "-q", "-w", "-g", "cpu", tmp_path / f"ours{suffix}", tmp_path / "theirs.ply"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    back = read_with_plyfile(tmp_path / "theirs.ply", degree)
    assert_close(back, truth, our_bounds(suffix, truth), in_order=suffix != ".compressed.ply")


def test_trimesh_shows_a_glb_as_coloured_points(tmp_path: Path, truth: Gaussians) -> None:
    """As a viewer without splats does, in glTF's axes: x left, y up, z forward."""
    write_scene(tmp_path / "scene.glb", truth)
    points = trimesh.load(tmp_path / "scene.glb", force="scene").to_geometry()
    np.testing.assert_allclose(points.vertices, truth.means * [-1, -1, 1], rtol=1e-6)
    srgb = np.clip(truth.colours, 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(points.colors[:, :3] / 255, linear, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(points.colors[:, 3] / 255, truth.opacities, atol=0.5 / 255 + 1e-6)


def test_the_official_validator_accepts_a_glb(tmp_path: Path, truth: Gaussians) -> None:
    """Khronos' own, which does not know the extension yet and therefore not the names of its attributes."""
    write_scene(tmp_path / "scene.glb", truth)
    program = (
        "const path = require('path');"
        "const folder = process.env.PATH.split(path.delimiter).find(p => p.includes('_npx'));"
        "const validator = require(path.join(folder, '..', 'gltf-validator'));"
        "validator.validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
        ".then(report => console.log(JSON.stringify(report.issues)));"
    )
    issues = json.loads(run_npx("gltf-validator@2.0.0-dev.3.10", ["node", "-e", program, str(tmp_path / "scene.glb")]))
    assert not issues["truncated"]
    named = {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    errors = [issue for issue in issues["messages"] if issue["severity"] <= 1]
    assert not [e for e in errors if e["code"] not in named or "KHR_gaussian_splatting" not in str(e)], errors


# ---- parts


@pytest.mark.parametrize("signs", [OPENGL, GLTF])
def test_a_half_turn_is_a_rotation_of_the_whole_scene(truth: Gaussians, signs: tuple[int, int, int]) -> None:
    """Drawn by a camera that turns along, the turned scene is the same picture."""
    turn = np.diag([*signs, 1.0])
    assert np.linalg.det(turn) == 1
    turned = half_turned(truth, signs)
    K = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    drawn = [
        rasterize(s.means, s.quats, s.scales, s.opacities, s.sh, viewmat, K, 80, 60).rgb
        for s, viewmat in ((truth, np.eye(4)), (turned, turn))
    ]
    assert drawn[0].max() > 0.5
    np.testing.assert_allclose(drawn[1], drawn[0], atol=2e-5)
    again = half_turned(turned, signs)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(truth, name))


def test_smallest_three_and_back() -> None:
    quats = unit_quaternions(np.random.default_rng(0).normal(size=(500, 4)) * 1e-9)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, rtol=1e-6)
    largest, others = smallest_three(quats)
    assert np.abs(others).max() <= np.sqrt(0.5) + 1e-6
    back = from_smallest_three(largest, others)
    sign = np.sign(np.take_along_axis(quats, largest[:, None], axis=1))
    np.testing.assert_allclose(back, quats * sign, atol=1e-6)
    extremes = np.float32([[0, 0, 0, 0], [1e30, 0, 0, 0], [3e38, -3e38, 0, 0]])
    np.testing.assert_allclose(unit_quaternions(extremes), [[1, 0, 0, 0], [1, 0, 0, 0], [0.5**0.5, -(0.5**0.5), 0, 0]])


def test_morton_order_keeps_neighbours_together() -> None:
    points = np.random.default_rng(0).permutation(np.stack(np.meshgrid(*[np.arange(16)] * 3), axis=-1).reshape(-1, 3))
    order = morton_order(points)
    assert sorted(order) == list(range(len(points)))
    cubes = points[order].reshape(-1, 64, 3)  # 4 x 4 x 4 neighbours each
    assert (np.ptp(cubes, axis=1) == 3).all()
    assert morton_order(np.zeros((3, 3))).tolist() == [0, 1, 2]


def test_chunks_keep_their_own_precision(tmp_path: Path) -> None:
    """Two clusters far apart: each is as fine as its own extent allows, not the scene's."""
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 0.01, (2 * CHUNK, 3)).astype(np.float32)
    means[CHUNK:] += 1000
    count = len(means)
    scene = Gaussians(
        means,
        np.full((count, 3), 0.01, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 0.5, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    write_scene(tmp_path / "scene.compressed.ply", scene)
    near = read_scene(tmp_path / "scene.compressed.ply").means
    near = near[near[:, 0] < 500]
    distance = np.abs(near[:, None] - means[None, :CHUNK]).max(axis=-1).min(axis=1)
    assert distance.max() <= 0.01 / 2046 + 1e-6


def test_spz_positions_are_as_fine_as_the_extent_allows(tmp_path: Path, truth: Gaussians) -> None:
    for factor in (1e-3, 1, 1e5):
        scene = Gaussians(truth.means * np.float32(factor), *(getattr(truth, name) for name in ARRAYS[1:]))
        write_scene(tmp_path / "scene.spz", scene)
        off = np.abs(read_scene(tmp_path / "scene.spz").means - scene.means).max()
        assert off <= max(1.5 * 2.0**-23 * np.abs(scene.means).max(), 2.0**-25)  # a half of it from float32
    with pytest.raises(InputError, match=r"reaches 8\.97782e\+06 units.*write a \.ply"):
        write_scene(
            tmp_path / "far.spz", Gaussians(truth.means * np.float32(1e6), *(getattr(truth, n) for n in ARRAYS[1:]))
        )
    assert not (tmp_path / "far.spz").exists()


def test_what_a_format_cannot_hold_is_said(tmp_path: Path, truth: Gaussians) -> None:
    scene = without_bands(truth, 1)
    scene.sh[3, 2, 1] = 5
    scene.scales[5, 0] = 1e-12
    scene.sh[7, 0] = 2 / SH_0
    notes = {suffix: " ".join(write_scene(tmp_path / f"scene{suffix}", scene)) for suffix in FORMATS}
    assert notes[".ply"] == ""
    assert "degree 1 to 1 left out" in notes[".splat"] and "3 of 810 colours outside 0 to 1" in notes[".splat"]
    for text in ("1 of 810 scales outside 4.54e-05", "1 of 2,430 spherical harmonics", "3 of 810 colours"):
        assert text in notes[".spz"]
    assert "1 of 810 scales" in notes[".compressed.ply"] and "1 of 2,430 spherical" in notes[".compressed.ply"]


# ---- names and the command


def test_the_longest_ending_counts() -> None:
    assert scene_suffix(Path("a/b.COMPRESSED.PLY")) == ".compressed.ply"
    assert scene_suffix(Path("a/b.c.ply")) == ".ply"
    with pytest.raises(InputError, match=r"scene\.txt: expected a splat file, whose name ends in \.ply, "):
        scene_suffix(Path("scene.txt"))


def test_a_compressed_ply_under_another_name(tmp_path: Path, truth: Gaussians) -> None:
    shutil.copy(DATA / "scene.compressed.ply", tmp_path / "scene.ply")
    assert len(read_scene(tmp_path / "scene.ply")) == len(truth)


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
    assert "note: spherical harmonics of degree 1 to 2 left out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.ply", "b.spz"), "none.ply"),
        (("a.ply", "b.txt"), "b.txt: expected a splat file"),
        (("a.txt", "b.ply"), "a.txt: expected a splat file"),
        (("a.ply", "nowhere/b.spz"), "nowhere"),
        (("a.ply", "a.ply"), "is the file to read"),
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


# ---- bad input


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, truth: Gaussians) -> dict[str, bytes]:
    """A small file of every format."""
    folder = tmp_path_factory.mktemp("written")
    small = Gaussians(*(getattr(truth, name)[:5] for name in ARRAYS))
    for suffix in FORMATS:
        write_scene(folder / f"scene{suffix}", small)
    return {suffix: (folder / f"scene{suffix}").read_bytes() for suffix in FORMATS}


def read_or_refuse(path: Path) -> Gaussians | None:
    """What a reader makes of a file, once its warnings are errors and its refusal is one line with the file's name."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            gaussians = read_scene(path)
        except InputError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
            return None
    for name in ARRAYS:
        assert np.isfinite(getattr(gaussians, name)).all()
    assert (gaussians.scales >= 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    return gaussians


@pytest.mark.parametrize("suffix", FORMATS)
def test_truncations_are_refused(tmp_path: Path, written: dict[str, bytes], suffix: str) -> None:
    path = tmp_path / f"cut{suffix}"
    content = written[suffix]
    for length in [*range(0, len(content), 17), *range(len(content) - 40, len(content))]:
        path.write_bytes(content[:length])
        whole = suffix == ".splat" and length % 32 == 0 and length  # nothing says that there were more
        assert (read_or_refuse(path) is not None) == bool(whole), length


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    "content", [b"", b"\x00" * 1000, b"\xff" * 999, b"ply\n", b"\x1f\x8b\x08", b"PK\x03\x04", b"glTF"]
)
def test_files_of_another_type_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"wrong{suffix}"
    path.write_bytes(content)
    assert read_or_refuse(path) is None


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("field", ["means", "scales", "quats", "opacities", "sh"])
def test_values_that_are_not_numbers_are_not_written(tmp_path: Path, truth: Gaussians, suffix: str, field: str) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(b"the result of yesterday")
    broken = Gaussians(*(getattr(truth, name).copy() for name in ARRAYS))
    getattr(broken, field)[17, ...] = np.nan
    with pytest.raises(InputError, match=r"Gaussian 17 is not"):
        write_scene(path, broken)
    assert path.read_bytes() == b"the result of yesterday"
    assert list(tmp_path.iterdir()) == [path]


def gzipped(content: bytes) -> bytes:
    compressor = zlib.compressobj(wbits=31)
    return compressor.compress(content) + compressor.flush()


def spz_header(
    count: int = 0, version: int = 3, degree: int = 0, bits: int = 12, flags: int = 0, magic: bytes = b"NGSP"
) -> bytes:
    numbers = np.array([version, count], "<u4").tobytes() + bytes([degree, bits, flags, 0])
    return magic + numbers


BROKEN_SPZ = {
    "version 4": (b"NGSP" + b"\x04" + b"\x00" * 40, "version 4"),
    "version 1": (gzipped(spz_header(version=1)), "version 1; expected version 2 or 3"),
    "other magic": (gzipped(spz_header(magic=b"GSPN")), "gzip stream of something else"),
    "short header": (gzipped(spz_header()[:10]), "cut short in its header"),
    "degree 4": (gzipped(spz_header(degree=4)), "SH degree 4; expected 0 to 3"),
    "bits": (gzipped(spz_header(bits=60)), "60 bits behind the point"),
    "extensions": (gzipped(spz_header(flags=2)), "has extensions"),
    "too few": (gzipped(spz_header(count=3) + b"\x00" * 59), "cut short: 3 Gaussians need 60 bytes"),
    "far too many": (gzipped(spz_header(count=1 << 31)), "2147483648 Gaussians cannot be in"),
    "checksum": (gzipped(spz_header(count=3) + b"\x00" * 60)[:-8] + b"\x00" * 8, "damaged"),
}


@pytest.mark.parametrize("name", BROKEN_SPZ)
def test_broken_spz_files_are_named(tmp_path: Path, name: str) -> None:
    content, message = BROKEN_SPZ[name]
    path = tmp_path / "broken.spz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_scene(path)


def test_a_bomb_does_not_go_off(tmp_path: Path) -> None:
    """A stream of zeros, 200 MB long in .2 MB, that its header calls a scene: refused before it is unpacked."""
    count = 10_000_000
    compressor = zlib.compressobj(wbits=31)
    content = compressor.compress(spz_header(count))
    zeros = bytes(20_000_000)
    content += b"".join(compressor.compress(zeros) for _ in range(10)) + compressor.flush()
    path = tmp_path / "bomb.spz"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match="10000000 Gaussians cannot be in"):
        read_scene(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * len(content) + 1e6


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
    back = read_scene(path)
    bounds = our_bounds(".spz", truth)._replace(means=(2.0**-13,) * 3, quats=2)
    assert_close(back, without_bands(truth, 0), bounds)
    # w is what x, y and z leave, so that only they are kept to half a step.
    np.testing.assert_allclose(back.quats[:, 1:], quats[:, 1:], atol=0.5 / 127.5 + 1e-6)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", FORMATS)
@given(data=st.data())
def test_any_mutation_gives_a_scene_or_an_input_error(
    tmp_path: Path, written: dict[str, bytes], suffix: str, data: st.DataObject
) -> None:
    """Inside a gzip stream, too: there, mutations are packed again."""
    packed = suffix == ".spz" and data.draw(st.booleans())
    content = bytearray(zlib.decompress(written[suffix], wbits=31) if packed else written[suffix])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 12))] = data.draw(st.binary(max_size=12))
    path = tmp_path / f"mutated{suffix}"
    path.write_bytes(gzipped(bytes(content)) if packed else content)
    read_or_refuse(path)
