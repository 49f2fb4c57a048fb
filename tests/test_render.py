"""Pictures out: the command idesplat-render, camera paths and PNG files."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras import Camera, write_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.gaussians import Gaussians
from idesplat.runtime.images_out import save_depth_png, save_png
from idesplat.runtime.paths import interpolate_extrinsics
from idesplat.runtime.ply import read_ply, write_ply
from idesplat.runtime.rasterizer import rasterize
from idesplat.runtime.render import draw_view, main, world_to_camera

SH_0 = 0.28209479177387814


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


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit status of the command with these arguments."""
    monkeypatch.setattr(sys, "argv", ["idesplat-render", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code or 0


def test_draws_every_camera_at_its_own_size(
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
    out = tmp_path / "new" / "pictures"
    status = run(
        monkeypatch,
        tmp_path / "scene.ply",
        "--cameras",
        tmp_path / "cameras.json",
        "--out",
        out,
        "--background",
        1,
        0,
        0.5,
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
    assert "300 Gaussians drawn in 2 pictures" in printed.out
    assert printed.err == ""


def test_a_transforms_json_worked_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An OpenGL camera at (0, 0, 3) looks along -z; what is right of and above its axis is so in the picture."""
    write_ply(tmp_path / "scene.ply", one_gaussian((0.5, 0.25, 1), (1, 0, 0)))
    matrix = np.eye(4)
    matrix[2, 3] = 3
    frame = {"file_path": "images/front.jpg", "transform_matrix": matrix.tolist()}
    camera = {"fl_x": 40, "fl_y": 40, "cx": 30.5, "cy": 20.5, "w": 61, "h": 41, "k1": 0.05, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(camera))
    out = tmp_path / "out"
    assert run(monkeypatch, tmp_path / "scene.ply", "--cameras", tmp_path / "transforms.json", "--out", out) == 0
    picture = read_rgb(out / "front.png")
    assert picture.shape == (41, 61, 3)
    # 0.5 / 2 * 40 = 10 pixels right of the axis, 0.25 / 2 * 40 = 5 above it
    assert np.unravel_index(picture[..., 0].argmax(), (41, 61)) == (20 - 5, 30 + 10)
    assert picture[15, 40].tolist() == [round(0.99 * 255), 0, 0]


@pytest.mark.parametrize("names", [("left/0001.jpg", "right/0001.jpg"), ("a\\0001.jpg", "0001.png")])
def test_pictures_never_overwrite_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, names: tuple[str, str]
) -> None:
    write_ply(tmp_path / "scene.ply", one_gaussian((0, 0, 2), (1, 1, 1)))
    write_cameras(tmp_path / "cameras.json", [Camera(name, 8, 8, pinhole(8, 8), np.eye(4)) for name in names])
    out = tmp_path / "out"
    assert run(monkeypatch, tmp_path / "scene.ply", "--cameras", tmp_path / "cameras.json", "--out", out) == 2
    assert f"cameras {names[0]} and {names[1]} would both be drawn to" in capsys.readouterr().err
    assert not out.exists()


def test_pictures_never_overwrite_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    (images / "0001.png").write_bytes(b"a photograph")
    write_ply(tmp_path / "scene.ply", one_gaussian((0, 0, 2), (1, 1, 1)))
    write_cameras(tmp_path / "cameras.json", [Camera("images/0001.png", 8, 8, pinhole(8, 8), np.eye(4))])
    assert run(monkeypatch, tmp_path / "scene.ply", "--cameras", tmp_path / "cameras.json", "--out", images) == 2
    assert "would overwrite the photograph" in capsys.readouterr().err
    assert (images / "0001.png").read_bytes() == b"a photograph"


@pytest.mark.parametrize(
    ("scene", "cameras", "background", "message"),
    [
        ("none.ply", "cameras.json", (0, 0, 0), "none.ply: No such file"),
        ("cameras.json", "cameras.json", (0, 0, 0), "cameras.json: expected a splat file"),
        ("scene.ply", "none.json", (0, 0, 0), "none.json"),
        ("scene.ply", "scene.ply", (0, 0, 0), "not valid JSON"),
        ("scene.ply", "cameras.json", (0, 255, 0), "--background is (0.0, 255.0, 0.0)"),
        ("scene.ply", "cameras.json", (0, "nan", 0), "--background is (0.0, nan, 0.0)"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    scene: str,
    cameras: str,
    background: tuple,
    message: str,
) -> None:
    write_ply(tmp_path / "scene.ply", one_gaussian((0, 0, 2), (1, 1, 1)))
    write_cameras(tmp_path / "cameras.json", [Camera("0001.jpg", 8, 8, pinhole(8, 8), np.eye(4))])
    out = tmp_path / "out"
    arguments = (tmp_path / scene, "--cameras", tmp_path / cameras, "--out", out, "--background", *background)
    assert run(monkeypatch, *arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert not out.exists()


def test_importing_the_command_loads_nothing_heavy() -> None:
    program = "import sys, idesplat.runtime.render\nassert not {'cv2', 'onnxruntime', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_draw_view_takes_camera_to_world() -> None:
    extrinsics = pose((0.3, -0.5, 0.2), (1, 2, 3))
    np.testing.assert_allclose(world_to_camera(extrinsics) @ extrinsics, np.eye(4), atol=1e-12)
    ahead = extrinsics @ [0.1, -0.2, 2, 1]  # in the camera's own frame 2 ahead, a little right and up
    drawn = draw_view(one_gaussian(tuple(ahead[:3]), (0, 1, 0)), extrinsics, pinhole(101, 81), 101, 81)
    # 50.5 + 101 * 0.1 / 2 = 55.55 and 40.5 - 101 * 0.2 / 2 = 30.4 are the pixels 55 and 30
    assert np.unravel_index(drawn.alpha.argmax(), (81, 101)) == (30, 55)
    assert drawn.depth[30, 55] / drawn.alpha[30, 55] == pytest.approx(2, abs=1e-5)


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
        with pytest.raises(InputError, match="expected one of each"):
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
    picture = read_rgb(tmp_path / "depth.png").astype(int)
    assert not picture[0, :3].any()
    red, green, blue = picture[10, 0]
    assert red > green + 50 and red > blue + 50
    red, green, blue = picture[10, 95]
    assert blue > red + 50
    # Colours follow inverse depth: the middle column, though at depth 1.8 of 1 to 10, has the map's middle, green.
    red, green, blue = picture[10, 50]
    assert green > red + 50 and green > blue + 50


@pytest.mark.parametrize("value", [0.0, 3.0, np.nan])
def test_depth_without_range(tmp_path: Path, value: float) -> None:
    save_depth_png(tmp_path / "depth.png", np.full((4, 5), value, np.float32))
    picture = read_rgb(tmp_path / "depth.png")
    assert picture.shape == (4, 5, 3)
    assert picture.any() == (value == 3.0)


def test_pictures_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    for path in (tmp_path / "none" / "a.png", tmp_path / "folder.png"):
        with pytest.raises(InputError, match="cannot write"):
            save_png(path, np.zeros((2, 2, 3)))
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]
