"""Images out: the command idesplat render, camera paths and PNG files."""

import json
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import write_cameras
from idesplat.runtime.cli import render
from idesplat.runtime.cli.render import main
from idesplat.runtime.errors import InputError
from idesplat.runtime.geometry.sh import SH_0
from idesplat.runtime.geometry.trajectories import interpolate_extrinsics, orbit_extrinsics
from idesplat.runtime.images import video_writer as video_out
from idesplat.runtime.images.png import save_depth_png, save_png
from idesplat.runtime.images.video_writer import open_video
from idesplat.runtime.rendering.cameras import fit_camera, orbit_cameras, overview_camera
from idesplat.runtime.rendering.rasterizer import rasterize
from idesplat.runtime.rendering.render import autofocus, render_view
from idesplat.runtime.splats.formats.ply import read_ply, write_ply
from idesplat.runtime.splats.gaussians import Gaussians


def one_gaussian(position: tuple[float, float, float], rgb: tuple[float, float, float]) -> Gaussians:
    """A ball of radius 0.05, opaque, of one colour from all sides."""
    return Gaussians(
        means=np.float32([position]),
        scales=np.full((1, 3), 0.05, np.float32),
        quats=np.float32([[1, 0, 0, 0]]),
        opacities=np.ones(1, np.float32),
        sh=(np.float32([[rgb]]) - np.float32(0.5)) / np.float32(SH_0),
    )


def pinhole(width: int, height: int) -> np.ndarray:
    return np.array([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])


def pose(axis_angle: tuple[float, float, float], position: tuple[float, float, float]) -> np.ndarray:
    extrinsics = np.eye(4)
    extrinsics[:3, :3] = cv2.Rodrigues(np.array(axis_angle, float))[0]
    extrinsics[:3, 3] = position
    return extrinsics


def read_rgb(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


def run(_: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit status of the command with these arguments."""
    return run_command(main, *arguments)


def test_renders_every_camera_at_its_own_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        means=rng.uniform([-1, -1, 2], [1, 1, 4], (300, 3)).astype(np.float32),
        scales=rng.uniform(0.02, 0.2, (300, 3)).astype(np.float32),
        quats=rng.normal(size=(300, 4)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.9, 300).astype(np.float32),
        sh=rng.normal(size=(300, 9, 3)).astype(np.float32) * 0.3,
    )
    views = [
        Camera("images/0001.jpg", 40, 30, pinhole(40, 30), pose((0, 0.1, 0), (0.2, 0, 0)), (0.1, 0, 0, 0)),
        Camera("images/0002.jpeg", 24, 32, pinhole(24, 32), pose((0.1, -0.2, 0), (0, 0.1, -1))),
    ]
    write_ply(tmp_path / "scene.ply", gaussians)
    write_cameras(tmp_path / "cameras.json", views)
    out = tmp_path / "new" / "images"
    status = run(
        monkeypatch,
        tmp_path / "scene.ply",
        "--cameras",
        tmp_path / "cameras.json",
        "--out",
        out,
        "--background",
        "1,0,0.5",
    )
    printed = capsys.readouterr()
    assert status == 0
    assert sorted(path.name for path in out.iterdir()) == ["0001.png", "0002.png"]
    stored = read_ply(tmp_path / "scene.ply")
    for view, name in zip(views, ("0001.png", "0002.png"), strict=True):
        viewmat = np.linalg.inv(view.extrinsics)
        arrays = (stored.means, stored.quats, stored.scales, stored.opacities, stored.sh)
        expected = rasterize(*arrays, viewmat, view.K, view.width, view.height, (1, 0, 0.5)).rgb
        # The inverse differs in its last bit, so that a value at a half may round the other way.
        np.testing.assert_allclose(read_rgb(out / name), np.clip(expected, 0, 1) * 255, atol=0.5 + 1e-3)
        assert str(out / name) in printed.out
    assert "300 Gaussians rendered in 2 images" in printed.out
    assert printed.err == ""


def test_a_transforms_json_worked_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An OpenGL camera at (0, 0, 3) looks along -z; what is right of and above its axis is so in the image."""
    write_ply(tmp_path / "scene.ply", one_gaussian((0.5, 0.25, 1), (1, 0, 0)))
    matrix = np.eye(4)
    matrix[2, 3] = 3
    frame = {"file_path": "images/front.jpg", "transform_matrix": matrix.tolist()}
    camera = {"fl_x": 40, "fl_y": 40, "cx": 30.5, "cy": 20.5, "w": 61, "h": 41, "k1": 0.05, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(camera))
    out = tmp_path / "out"
    assert run(monkeypatch, tmp_path / "scene.ply", "--cameras", tmp_path / "transforms.json", "--out", out) == 0
    image = read_rgb(out / "front.png")
    assert image.shape == (41, 61, 3)
    # 0.5 / 2 * 40 = 10 pixels right of the axis, 0.25 / 2 * 40 = 5 above it
    assert np.unravel_index(image[..., 0].argmax(), (41, 61)) == (20 - 5, 30 + 10)
    assert image[15, 40].tolist() == [round(0.99 * 255), 0, 0]


@pytest.mark.parametrize(
    ("names", "written"),
    [
        (("left/0001.jpg", "right/0001.jpg"), ("left-0001", "right-0001")),
        (("a\\0001.jpg", "0001.png"), ("a-0001", "0001")),
        (("r_0.5", "r_0.7"), ("r_0.5", "r_0.7")),
        (("a.png", "a.jpg", "0-a.png"), ("0-a", "1-a", "2-0-a")),
        (("A.jpg", "a.jpg"), ("0-A", "1-a")),
    ],
)
def test_images_never_overwrite_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...], written: tuple[str, ...]
) -> None:
    write_ply(tmp_path / "scene.ply", one_gaussian((0, 0, 2), (1, 1, 1)))
    write_cameras(tmp_path / "cameras.json", [Camera(name, 8, 8, pinhole(8, 8), np.eye(4)) for name in names])
    out = tmp_path / "out"
    assert run(monkeypatch, tmp_path / "scene.ply", "--cameras", tmp_path / "cameras.json", "--out", out) == 0
    assert {path.name for path in out.iterdir()} == {f"{name}.png" for name in written}


@pytest.mark.parametrize(
    ("scene", "cameras", "background", "message"),
    [
        ("none.ply", "cameras.json", "0,0,0", "none.ply: No such file"),
        ("cameras.json", "cameras.json", "0,0,0", "cameras.json: expected a splat file"),
        ("scene.ply", "none.json", "0,0,0", "none.json"),
        ("scene.ply", "scene.ply", "0,0,0", "scene.ply: holds no cameras of a known format"),
        ("scene.ply", "cameras.json", "0,255,0", "--background 0,255,0: expected red, green and blue from 0 to 1"),
        ("scene.ply", "cameras.json", "0,nan,0", "--background 0,nan,0"),
        ("scene.ply", "cameras.json", "1,1", "--background 1,1"),
        ("scene.ply", "cameras.json", "white", "--background white"),
        ("scene.ply", "cameras.json", "1,1,1,1", "--background 1,1,1,1"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    scene: str,
    cameras: str,
    background: str,
    message: str,
) -> None:
    write_ply(tmp_path / "scene.ply", one_gaussian((0, 0, 2), (1, 1, 1)))
    write_cameras(tmp_path / "cameras.json", [Camera("0001.jpg", 8, 8, pinhole(8, 8), np.eye(4))])
    out = tmp_path / "out"
    arguments = (tmp_path / scene, "--cameras", tmp_path / cameras, "--out", out, "--background", background)
    assert run(monkeypatch, *arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert not out.exists()


def test_importing_the_command_loads_nothing_heavy() -> None:
    program = "import sys, idesplat.runtime.cli.render\nassert not {'cv2', 'onnxruntime', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_render_view_takes_camera_to_world() -> None:
    extrinsics = pose((0.3, -0.5, 0.2), (1, 2, 3))
    ahead = extrinsics @ [0.1, -0.2, 2, 1]  # in the camera's own frame 2 ahead, a little right and up
    rendered = render_view(one_gaussian(tuple(ahead[:3]), (0, 1, 0)), extrinsics, pinhole(101, 81), 101, 81)
    # 50.5 + 101 * 0.1 / 2 = 55.55 and 40.5 - 101 * 0.2 / 2 = 30.4 are the pixels 55 and 30
    assert np.unravel_index(rendered.alpha.argmax(), (81, 101)) == (30, 55)
    assert rendered.depth[30, 55] / rendered.alpha[30, 55] == pytest.approx(2, abs=1e-5)


# ---- stills, orbits, paths, videos


def a_ball_of_gaussians(centre: tuple[float, float, float] = (1, -2, 5), count: int = 300) -> Gaussians:
    rng = np.random.default_rng(1)
    offsets = rng.normal(size=(count, 3))
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
    return Gaussians(
        means=(np.array(centre) + offsets).astype(np.float32),
        scales=np.full((count, 3), 0.1, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacities=np.full(count, 0.9, np.float32),
        sh=rng.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )


@pytest.fixture
def ball_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """scene.ply with a ball of Gaussians, in the folder in which the test stands."""
    monkeypatch.chdir(tmp_path)
    write_ply(Path("scene.ply"), a_ball_of_gaussians())


def read_video(path: Path) -> tuple[np.ndarray, float]:
    """All frames as RGB, [frames, height, width, 3], and how many a second."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [
            frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray() for frame in container.decode(stream)
        ]
        return np.stack(frames), float(stream.average_rate)


def psnr(rendered: np.ndarray, expected: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(rendered / 255 - np.clip(expected, 0, 1)).mean()))


@pytest.mark.parametrize(("height", "width"), [(40, 60), (60, 40)])
def test_an_overview_shows_all_of_the_scene_and_little_else(height: int, width: int) -> None:
    camera = overview_camera(a_ball_of_gaussians(), height, width)
    alpha = render_view(a_ball_of_gaussians(), camera.extrinsics, camera.K, width, height).alpha
    rows, columns = np.nonzero(alpha > 0.2)
    assert rows.min() > 0 and rows.max() < height - 1 and columns.min() > 0 and columns.max() < width - 1
    # It fits the sphere around the box, not the ball itself, hence with room to spare.
    assert np.ptp(rows) > 0.4 * min(height, width) and np.ptp(columns) > 0.4 * min(height, width)
    np.testing.assert_array_equal(camera.extrinsics[:3, :3], np.eye(3))
    with pytest.raises(InputError, match="nothing to render"):
        faint = a_ball_of_gaussians()
        faint.opacities[:] = 0.01
        overview_camera(faint, height, width)


def test_an_orbit_keeps_looking_at_its_pivot() -> None:
    start, pivot = pose((0.1, 0.2, 0), (0, 0, -4)), np.array([0.5, 0.2, 0])
    poses = orbit_extrinsics(start, pivot, np.array([0, -2.0, 0]), 360, 8)
    np.testing.assert_allclose(poses[0], start, atol=1e-12)
    seen = [np.linalg.inv(camera)[:3] @ [*pivot, 1] for camera in poses]
    np.testing.assert_allclose(seen, [seen[0]] * 8, atol=1e-12)  # at the same place of every image
    np.testing.assert_allclose(poses[:, 1, 3], 0, atol=1e-12)  # at the same height
    np.testing.assert_allclose((poses[2, :3, 3] - pivot)[[0, 2]], [4, -0.5], atol=1e-12)  # a quarter on: from the right
    np.testing.assert_allclose(poses[:, :3, 3].mean(axis=0), [0.5, 0, 0], atol=1e-12)
    swing = orbit_extrinsics(start, pivot, np.array([0, -2.0, 0]), 30, 8)
    turned = [np.degrees(np.linalg.norm(cv2.Rodrigues(camera[:3, :3] @ start[:3, :3].T)[0])) for camera in swing]
    np.testing.assert_allclose(
        turned, [0, 15 * 0.5**0.5, 15, 15 * 0.5**0.5, 0, 15 * 0.5**0.5, 15, 15 * 0.5**0.5], atol=1e-6
    )
    np.testing.assert_allclose(swing[2] @ np.linalg.inv(start) @ swing[6], start, atol=0.2)  # to either side
    for degrees, frames in ((0, 5), (361, 5), (float("nan"), 5), (90, 0)):
        with pytest.raises(InputError, match="orbit of"):
            orbit_extrinsics(start, pivot, np.array([0, -1.0, 0]), degrees, frames)


def test_an_orbit_of_cameras_that_are_upside_down_to_each_other(tmp_path: Path) -> None:
    upright = Camera("a", 32, 32, pinhole(32, 32), pose((0, 0, 0), (0, 0, -4)))
    turned = replace(upright, extrinsics=upright.extrinsics @ np.diag([-1.0, -1, 1, 1]))
    found = orbit_cameras(a_ball_of_gaussians((0, 0, 0)), [upright, turned], 30, 4)
    assert all(np.isfinite(camera.extrinsics).all() for camera in found)


def test_an_orbit_goes_around_what_the_cameras_look_at() -> None:
    ball = a_ball_of_gaussians((0, 0, 0))
    cameras = [Camera(f"{x}", 40, 30, pinhole(40, 30), pose((0, 0, 0), (x, 0, -4))) for x in (-0.1, 0.0, 0.1)]
    orbit = orbit_cameras(ball, cameras, 360, 4)
    np.testing.assert_allclose(orbit[0].extrinsics, cameras[1].extrinsics, atol=1e-12)
    opposite = orbit[2].extrinsics
    np.testing.assert_allclose(opposite[:3, 2], [0, 0, -1], atol=1e-9)
    assert -1 < (opposite[2, 3] - 4) / 2 < 0  # the pivot is on the ball's near side, between -1 and 0
    with pytest.raises(InputError, match="sees nothing of the scene"):
        orbit_cameras(ball, [Camera("away", 40, 30, pinhole(40, 30), pose((0, np.pi, 0), (0, 0, -4)))], 360, 4)


def test_another_size_shows_what_the_camera_showed() -> None:
    ball = a_ball_of_gaussians((0, 0, 4))
    camera = Camera("a", 60, 40, pinhole(60, 40), np.eye(4))
    wide = fit_camera(camera, 40, 100)
    whole = render_view(ball, wide.extrinsics, wide.K, 100, 40).rgb
    own = render_view(ball, camera.extrinsics, camera.K, 60, 40).rgb
    np.testing.assert_allclose(whole[:, 20:80], own, atol=1e-5)
    half = fit_camera(camera, 20, 30)
    np.testing.assert_allclose(half.K, [[30, 0, 15], [0, 30, 10], [0, 0, 1]])


def test_a_still_without_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ply(tmp_path / "scene.ply", a_ball_of_gaussians())
    assert run(monkeypatch, tmp_path / "scene.ply", "--out", tmp_path / "still.png", "--size", "48x64") == 0
    image = read_rgb(tmp_path / "still.png")
    camera = overview_camera(a_ball_of_gaussians(), 48, 64)
    expected = render_view(a_ball_of_gaussians(), camera.extrinsics, camera.K, 64, 48).rgb
    assert psnr(image, expected) > 45
    assert {path.name for path in tmp_path.iterdir()} == {"scene.ply", "still.png"}


@pytest.mark.usefixtures("ball_file")
def test_capital_endings_are_written_in_small_letters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert run(monkeypatch, "scene.ply", "--out", "Shot.PNG", "--size", "32x48") == 0
    assert "Shot.PNG" not in capsys.readouterr().out
    assert Path("Shot.png").is_file()


def test_depth_and_alpha_beside_the_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ball = one_gaussian((0, 0, 3), (1, 1, 1))
    write_ply(tmp_path / "scene.ply", ball)
    write_cameras(tmp_path / "cameras.json", [Camera("a.jpg", 41, 31, pinhole(41, 31), np.eye(4))])
    out = tmp_path / "out"
    arguments = (tmp_path / "scene.ply", "--cameras", tmp_path / "cameras.json", "--out", out, "--depth", "--alpha")
    assert run(monkeypatch, *arguments) == 0
    names = ["a-alpha.png", "a-depth.npz", "a-depth.png", "a.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    depth = np.load(out / "a-depth.npz")["depth"]
    assert depth[15, 20] == pytest.approx(3, abs=1e-5)  # metric, though the splat lets 1 % of the light through
    assert depth[0, 0] == 0
    assert read_rgb(out / "a-alpha.png")[15, 20].tolist() == [round(0.99 * 255)] * 3
    assert not read_rgb(out / "a-alpha.png")[0, 0].any()
    assert read_rgb(out / "a-depth.png")[15, 20].any() and not read_rgb(out / "a-depth.png")[0, 0].any()


def test_an_orbit_as_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    ball = a_ball_of_gaussians()
    write_ply(tmp_path / "scene.ply", ball)
    out = tmp_path / "orbit.mp4"
    options = ("--orbit", "--frames", 6, "--fps", 12, "--size", "97x128", "--depth", "--alpha")
    assert run(monkeypatch, tmp_path / "scene.ply", "--out", out, *options) == 0
    orbit = orbit_cameras(ball, [overview_camera(ball, 97, 128)], 360, 6)
    films = {name: read_video(tmp_path / f"orbit{name}.mp4") for name in ("", "-depth", "-alpha")}
    assert {path.name for path in tmp_path.iterdir()} == {"scene.ply", *(f"orbit{name}.mp4" for name in films)}
    for frames, fps in films.values():
        assert frames.shape == (6, 98, 128, 3)  # videos have even sides
        assert fps == pytest.approx(12)
    for index, camera in enumerate(orbit):
        rendered = render_view(ball, camera.extrinsics, camera.K, 128, 97)
        assert psnr(films[""][0][index][:97], rendered.rgb) > 25
        assert psnr(films["-alpha"][0][index][:97], np.repeat(rendered.alpha[..., None], 3, axis=2)) > 25
    assert psnr(films[""][0][3][:97], render_view(ball, orbit[0].extrinsics, orbit[0].K, 128, 97).rgb) < 25
    assert "orbit-depth.mp4" in capsys.readouterr().out


@pytest.mark.usefixtures("ball_file")
def test_many_images_are_reported_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    assert run(monkeypatch, "scene.ply", "--orbit", "--frames", 9, "--depth", "--size", "24x32", "--out", "out") == 0
    wrote, last = capsys.readouterr().out.splitlines()
    assert wrote == "wrote 27 files in out" and last.endswith("rendered in 9 images; open out in any image viewer")
    assert len(list(Path("out").iterdir())) == 27


def test_a_path_through_the_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ball = a_ball_of_gaussians((0, 0, 0))
    write_ply(tmp_path / "scene.ply", ball)
    cameras = [Camera(f"{index}", 40, 30, pinhole(40, 30), pose((0, 0, 0), (index, 0, -4))) for index in range(3)]
    write_cameras(tmp_path / "cameras.json", cameras)
    options = ("--cameras", tmp_path / "cameras.json", "--path", "--frames", 5, "--out", tmp_path / "out")
    assert run(monkeypatch, tmp_path / "scene.ply", *options) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        f"frame-{index:04d}.png" for index in range(5)
    ]
    for index, x in enumerate((0, 0.5, 1, 1.5, 2)):
        expected = render_view(ball, pose((0, 0, 0), (x, 0, -4)), pinhole(40, 30), 40, 30).rgb
        assert psnr(read_rgb(tmp_path / "out" / f"frame-{index:04d}.png"), expected) > 45


@pytest.mark.usefixtures("ball_file")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--out", "out", "--path"), "--path: needs the cameras"),
        (("--out", "out", "--path", "--orbit"), "expected one of them"),
        (("--out", "out", "--size", "huge"), "--size huge: expected HEIGHTxWIDTH"),
        (("--out", "out", "--orbit", "--degrees", "400"), "expected one frame, 0 to 360 degrees"),
        (("--out", "out", "--orbit", "--degrees", "0"), "expected one frame, 0 to 360 degrees"),
        (("--out", "out", "--degrees", "20"), "--degrees 20: is of the orbit; add --orbit"),
        (("--out", "out", "--frames", "5"), "--frames 5: is of --orbit and --path"),
        (("--out", "out", "--orbit", "--fps", "5"), "--fps 5: is of a video"),
        (("--out", "out", "--camera-format", "colmap"), "--camera-format colmap: is of --cameras"),
        (("--out", "a.mp4", "--fps", "0.0004"), "--fps 0.0004: expected frames a second"),
        (("--out", "a.mp4", "--cameras", "cameras.json"), "a video has one size; add --size"),
        (("--out", "a.png", "--cameras", "cameras.json"), "2 images do not fit one file"),
        (("--out", "a.png", "--orbit"), "90 images do not fit one file"),
        (("--out", "scene.ply/a.mp4"), "scene.ply is not a folder"),
        (("--out", "out", "--size", "9000x9000"), "sides of 8192 pixels at most"),
        (("--out", "out", "--orbit", "--frames", "10001"), "--frames 10001: expected 1 to 10000"),
        (("--out", "a.mp4", "--orbit", "--frames", "0"), "--frames 0: expected 1 to 10000"),
        (("--out", "a.jpg"), "--out a.jpg: expected a folder, or a file that ends in .png or .mp4"),
        (("--out", "a.MOV", "--orbit"), "expected a folder, or a file that ends in .png or .mp4"),
        (("--out", "out", "--aperture", "-0.1"), "--aperture -0.1: expected the lens's diameter in scene units"),
        (("--out", "out", "--aperture", "nan"), "--aperture nan: expected the lens's diameter in scene units"),
        (("--out", "out", "--aperture", "inf"), "--aperture inf: expected the lens's diameter in scene units"),
        (("--out", "out", "--aperture", "1", "--focus", "0"), "--focus 0: expected a distance in scene units above 0"),
        (("--out", "out", "--aperture", "1", "--focus", "-2"), "--focus -2: expected a distance"),
        (("--out", "out", "--aperture", "1", "--focus", "nan"), "--focus nan: expected a distance"),
        (("--out", "out", "--aperture", "1", "--focus", "far"), "--focus far: expected a distance"),
        (("--out", "out", "--focus", "2"), "--focus 2: needs a lens; give its diameter in scene units as --aperture"),
    ],
)
def test_requests_that_make_no_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, options: tuple, message: str
) -> None:
    cameras = [Camera(f"{size}", size, 30, pinhole(size, 30), pose((0, 0, 0), (1, -2, 0))) for size in (20, 30)]
    write_cameras(Path("cameras.json"), cameras)
    assert run(monkeypatch, "scene.ply", *options) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"scene.ply", "cameras.json"}


def test_a_lens_blurs_what_is_out_of_focus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """--focus auto is the depth of the ball in the middle of the first image, also for the second."""
    monkeypatch.chdir(tmp_path)
    ball = a_ball_of_gaussians()
    write_ply(Path("scene.ply"), ball)
    cameras = [Camera(name, 40, 30, pinhole(40, 30), pose((0, 0, 0), (1, -2, z))) for name, z in (("a", 0), ("b", -2))]
    write_cameras(Path("cameras.json"), cameras)
    distance = autofocus(ball, cameras[0])
    assert 4 < distance < 5  # the ball's front, about 5 away
    for options, focus in ((("--focus", "auto"), distance), ((), distance), (("--focus", "7"), 7.0)):
        arguments = ("scene.ply", "--cameras", "cameras.json", "--aperture", "0.5", *options, "--out", "out")
        assert run(monkeypatch, *arguments) == 0
        noted = capsys.readouterr().out.splitlines()[0]
        chosen = "" if focus == 7 else ", the median depth in the middle of the first image (a)"
        assert noted == f"in focus at {focus:.4g}{chosen}; what is far behind is blurred over {20 / focus:.3g} pixels"
        for camera in cameras:
            expected = render_view(ball, camera.extrinsics, camera.K, 40, 30, aperture=0.5, focus=focus).rgb
            stored = read_rgb(Path("out") / f"{camera.name}.png")
            np.testing.assert_allclose(stored, np.clip(expected, 0, 1) * 255, atol=0.6)  # the file rounds opacities
    assert run(monkeypatch, *arguments, "--quiet") == 0
    assert "in focus" not in capsys.readouterr().out


@pytest.mark.usefixtures("ball_file")
def test_an_aperture_of_zero_is_the_pinhole(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    assert run(monkeypatch, "scene.ply", "--size", "24x32", "--out", "pinhole.png") == 0
    for number, options in enumerate(((), ("--focus", "auto"), ("--focus", "2"))):
        assert (
            run(monkeypatch, "scene.ply", "--size", "24x32", "--aperture", "0", *options, "--out", f"{number}.png") == 0
        )
        assert Path(f"{number}.png").read_bytes() == Path("pinhole.png").read_bytes()
    assert "in focus" not in capsys.readouterr().out


@pytest.mark.usefixtures("ball_file")
def test_a_lens_with_nothing_to_focus_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    write_cameras(Path("cameras.json"), [Camera("away", 40, 30, pinhole(40, 30), pose((0, 3, 0), (1, -2, 0)))])
    arguments = ("scene.ply", "--cameras", "cameras.json", "--aperture", "0.5", "--out", "out")
    assert run(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert "the camera away has nothing in the middle of its image to focus on; give a focus distance" in error
    assert error.count("\n") == 1
    assert not Path("out").exists()
    assert run(monkeypatch, *arguments, "--focus", "3") == 0


def test_cameras_of_an_image_too_large_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    write_ply(tmp_path / "scene.ply", a_ball_of_gaussians())
    for width, height, message in ((9000, 9000, "would take 4.5 GB"), (5, 70_000, "sides of 65,536 at most")):
        K = np.array([[width, 0, width / 2], [0, height, height / 2], [0, 0, 1]])
        camera = Camera("a", width, height, K, pose((0, 0, 0), (1, -2, 0)))
        write_cameras(tmp_path / "cameras.json", [camera])
        options = ("--cameras", tmp_path / "cameras.json", "--out", tmp_path / "out", "--overwrite")
        assert run(monkeypatch, tmp_path / "scene.ply", *options) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_a_depth_image_never_overwrites_another_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ply(tmp_path / "scene.ply", a_ball_of_gaussians())
    cameras = [Camera(name, 20, 30, pinhole(20, 30), pose((0, 0, 0), (1, -2, 0))) for name in ("a.jpg", "a-depth.jpg")]
    write_cameras(tmp_path / "cameras.json", cameras)
    options = ("--cameras", tmp_path / "cameras.json", "--out", tmp_path / "out", "--depth")
    assert run(monkeypatch, tmp_path / "scene.ply", *options) == 0
    stems = ("0-a", "1-a-depth")
    endings = (".png", "-depth.png", "-depth.npz")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {stem + end for stem in stems for end in endings}


def test_a_video_is_what_browsers_play(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    frame = np.stack([*np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 1, 33)), np.full((33, 65), 0.5)], axis=-1)
    with open_video(path, 65, 33, 30000 / 1001) as add:
        for _ in range(4):
            add(frame)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (container.format.name.split(",")[0], stream.codec_context.name) == ("mov", "h264")
        assert stream.pix_fmt == "yuv420p" and (stream.width, stream.height) == (66, 34)
        assert stream.average_rate == Fraction(30000, 1001)
        assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 1)  # BT.709, limited
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")
    frames, _ = read_video(path)
    assert len(frames) == 4 and psnr(frames[2][:33, :65], frame) > 35
    np.testing.assert_array_equal(frames[0][33, :64] // 8, frames[0][32, :64] // 8)  # padded with what is beside


@pytest.mark.usefixtures("ball_file")
def test_a_video_without_its_library(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(video_out, "find_spec", lambda name: None)
    assert run(monkeypatch, "scene.ply", "--orbit", "--out", "a.mp4") == 2
    assert "pip install 'idesplat[video]'" in capsys.readouterr().err
    assert not Path("a.mp4").exists()


@pytest.mark.usefixtures("ball_file")
def test_folders_are_made_and_left_only_with_what_they_are_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert run(monkeypatch, "scene.ply", "--size", "24x32", "--out", "new/folder/a.png") == 0
    assert run(monkeypatch, "scene.ply", "--size", "24x32", "--frames", 2, "--orbit", "--out", "new/one/a.mp4") == 0
    assert {path.name for path in Path("new").rglob("*.*")} == {"a.png", "a.mp4"}

    def fails(*arguments: object) -> None:
        raise InputError("it cannot be rendered")

    monkeypatch.setattr(render, "render_view", fails)
    for out in ("other/one/a.mp4", "other/a.png", "other/folder"):
        assert run(monkeypatch, "scene.ply", "--size", "24x32", "--out", out) == 2
        assert "it cannot be rendered" in capsys.readouterr().err
    assert not Path("other").exists()


# ---- camera paths

VIEWS = np.stack(
    [
        pose((0, 0, 0), (0, 0, 0)),
        pose((0, 0.5, 0), (1, 0, 0)),
        pose((0.2, 0.7, -0.1), (2, 1, 0)),
        pose((0, 0, 2), (2, 2, 2)),
    ]
)


def test_a_path_meets_every_view() -> None:
    path = interpolate_extrinsics(VIEWS, 31)
    assert path.shape == (31, 4, 4)
    np.testing.assert_allclose(path[::10], VIEWS, atol=1e-12)
    np.testing.assert_allclose(
        path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (31, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1)


def test_halfway_between_two_views() -> None:
    path = interpolate_extrinsics(np.stack([pose((0, 0.2, 0), (0, 0, 0)), pose((0, 0.8, 0), (2, 0, 4))]), 3)
    np.testing.assert_allclose(path[1], pose((0, 0.5, 0), (1, 0, 2)), atol=1e-12)


def test_the_camera_turns_the_shorter_way() -> None:
    path = interpolate_extrinsics(np.stack([pose((0, 3.0, 0), (0, 0, 0)), pose((0, -3.0, 0), (0, 0, 0))]), 3)
    np.testing.assert_allclose(path[1], pose((0, np.pi, 0), (0, 0, 0)), atol=1e-12)


def test_a_path_has_no_corners() -> None:
    positions = interpolate_extrinsics(VIEWS, 3001)[:, :3, 3]
    velocity = np.diff(positions, axis=0) * 1000  # world units a view
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() < 0.02


def test_paths_of_one_view_or_frame() -> None:
    np.testing.assert_array_equal(interpolate_extrinsics(VIEWS[2:3], 4), np.repeat(VIEWS[2:3], 4, axis=0))
    np.testing.assert_allclose(interpolate_extrinsics(VIEWS, 1), VIEWS[:1], atol=1e-12)
    for views, frames in ((VIEWS, 0), (VIEWS[:0], 5)):
        with pytest.raises(InputError, match="expected at least one of each"):
            interpolate_extrinsics(views, frames)


# ---- PNG files


def test_colours_are_rounded_and_clipped(tmp_path: Path) -> None:
    rgb = np.float32([[[0, 0.5, 1], [-3, 2, 0.25]]])
    save_png(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), [[[0, 128, 255], [0, 255, 64]]])


def test_near_is_warm_and_unknown_is_black(tmp_path: Path) -> None:
    depth = np.repeat(1 / np.linspace(1, 0.1, 101, dtype=np.float32)[None], 20, axis=0)
    depth[0, :3] = 0, np.nan, np.inf
    save_depth_png(tmp_path / "depth.png", depth)
    image = read_rgb(tmp_path / "depth.png").astype(int)
    assert not image[0, :3].any()
    red, green, blue = image[10, 0]
    assert red > green + 50 and red > blue + 50
    red, green, blue = image[10, 95]
    assert blue > red + 50
    # Colours follow inverse depth: the middle column, though at depth 1.8 of 1 to 10, has the map's middle, green.
    red, green, blue = image[10, 50]
    assert green > red + 50 and green > blue + 50


@pytest.mark.parametrize("value", [0.0, 3.0, np.nan])
def test_depth_without_range(tmp_path: Path, value: float) -> None:
    save_depth_png(tmp_path / "depth.png", np.full((4, 5), value, np.float32))
    image = read_rgb(tmp_path / "depth.png")
    assert image.shape == (4, 5, 3)
    assert image.any() == (value == 3.0)


def test_images_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    for path in (tmp_path / "none" / "a.png", tmp_path / "folder.png"):
        with pytest.raises(InputError, match="cannot write"):
            save_png(path, np.zeros((2, 2, 3)))
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]
