"""The command `idesplat infer`, as a user meets it: results, and one line for everything that is wrong."""

import json
import shlex
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from conftest import run_command
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.cli.infer import _named_after, main
from idesplat.runtime.cli.render import main as render_main
from idesplat.runtime.cli.view import main as view_main
from idesplat.runtime.inference.inputs import select_images
from idesplat.runtime.splats.formats.ply import read_ply
from idesplat.runtime.splats.io import read_splats
from idesplat.runtime.system.files import atomic_write
from idesplat.runtime.system.outputs import Outputs
from idesplat.tools.synthetic.make_scene import make_scene


@pytest.fixture
def workplace(scene, exported, tmp_path, monkeypatch):
    """A folder of one's own with the images, their cameras and the model, and we stand in it."""
    shutil.copytree(scene / "images", tmp_path / "images")
    shutil.copy(scene / "transforms.json", tmp_path)
    shutil.copy(exported[0], tmp_path / "model.onnx")
    monkeypatch.chdir(tmp_path)
    return tmp_path


USUAL = ("--images", "images", "--cameras", "transforms.json", "--model", "model.onnx", "--out", "scene.ply")


def test_everything_it_can_write(workplace, scene, capsys):
    extras = ("--save-depth", "depth", "--render", "views", "--timings", "--json", "summary.json", "--views", "3")
    assert run_command(main, *USUAL, *extras) == 0
    gaussians = read_ply(Path("scene.ply"))
    assert len(gaussians) == 3 * 64 * 96
    assert gaussians.sh_degree == 2
    summary = json.loads(Path("summary.json").read_text())
    assert summary["gaussians"] == len(gaussians)
    assert len(summary["views"]) == 3
    assert summary["model"]["preset"] == "idesplat-small"
    true_depth = np.stack([np.load(path)["depth"] for path in (scene / "depth").iterdir()])
    assert 0.3 * true_depth.min() < summary["near"] < np.median(true_depth) < summary["far"] < 4 * true_depth.max()
    assert "points matched between the images" in summary["near_far_from"]
    assert "3 of 5 images used" in summary["notes"][0] and "parallax" in summary["notes"][0]
    depths = sorted(Path("depth").glob("*.npz"))
    assert len(depths) == len(list(Path("depth").glob("*.png"))) == 3
    with np.load(depths[0]) as file:
        assert file["depth"].shape == (64, 96)
        assert np.isfinite(file["depth"]).all()
    assert len(list(Path("views").glob("view-*.png"))) == 3
    frames = sorted(Path("views").glob("path-*.png"))
    assert len(frames) == 24
    assert cv2.imread(str(frames[0])).shape == (64, 96, 3)
    printed = capsys.readouterr().out
    assert f"near {summary['near']:.4g} and far {summary['far']:.4g}" in printed
    size = Path("scene.ply").stat().st_size / 1e6
    assert (
        f"wrote scene.ply: {len(gaussians):,} Gaussians, {size:.1f} MB, in {summary['seconds']['total']:.1f} s"
        in printed
    )
    for text in (
        "wrote scene.ply",
        "wrote summary.json",
        "3 of 5 images",
        "idesplat view scene.ply",
        "idesplat render scene.ply",
        "wrote depth: 3 depth maps",
        "wrote views: 3 views and 24 frames",
        "total",
    ):
        assert text in printed
    assert "path-0" not in printed  # not line by line
    assert len(summary["files"]) == 1 + 6 + 27
    assert list(summary["seconds"]) == ["load", "prepare", "model", "write", "total"]


def test_commands_to_copy_work_in_folders_with_spaces(workplace, capsys):
    Path("images").rename("my images")
    Path("transforms.json").rename("my cameras")
    given = ("--images", "my images", "--cameras", "my cameras", "--camera-format", "transforms")
    assert run_command(main, *given, "--model", "model.onnx", "--out", "my scene.ply") == 0
    printed = capsys.readouterr().out
    view, render = (shlex.split(line) for line in printed.splitlines() if line.startswith("    "))
    cameras = ["--cameras", "my cameras", "--camera-format", "transforms"]
    assert view == ["idesplat", "view", "my scene.ply", *cameras, "--images", "my images"]
    assert render == ["idesplat", "render", "my scene.ply", *cameras, "--out", "DIR"]
    assert run_command(render_main, *render[2:]) == 0
    assert run_command(view_main, *view[2:], "--html", "page.html") == 0


def test_what_is_not_used_is_said(workplace, capsys, monkeypatch):
    assert run_command(main, *USUAL, "--views", "9") == 0
    printed = capsys.readouterr()
    assert "--views 9: all 5 images used" in printed.out
    assert "of each image is used" not in printed.out  # nearly all is
    assert printed.err == ""  # where that is no terminal
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert run_command(main, *USUAL, "--size", "128x64", "--select", "0,1") == 0
    # of 128 x 96 pixels, at a trained size of 96 x 64
    printed = capsys.readouterr()
    assert "of each image the middle 128x64 is used, 37 % of it; leave out --size" in printed.out
    for doing in ("reading cameras", "choosing and reading images", "finding near and far", "predicting"):
        assert doing in printed.err


def test_staged_folder_and_a_list_of_files(workplace, exported):
    files = sorted(Path("images").iterdir())[:2]
    arguments = ("--images", *files, "--cameras", "transforms.json", "--model", exported[1], "--out", "scene.ply")
    assert run_command(main, *arguments) == 0
    assert len(read_ply(Path("scene.ply"))) == 2 * 64 * 96


def test_filters_are_counted_and_formats_follow_the_name(workplace, capsys):
    filters = ("--crop-border", "4", "--min-opacity", "0.01", "--merge-duplicates")
    arguments = (*USUAL[:-1], "scene.spz", "--json", "summary.json", *filters)
    assert run_command(main, *arguments) == 0
    summary = json.loads(Path("summary.json").read_text())
    left_out = summary["filtered"]["left_out"]
    assert list(left_out) == ["min_opacity", "crop_border", "merge_duplicates"]
    assert left_out["crop_border"] > 0
    left = len(read_splats(Path("scene.spz")))
    assert left == summary["gaussians"] == 2 * 64 * 96 - sum(left_out.values())
    assert f"{left:,} Gaussians left" in capsys.readouterr().out


def test_points_and_surfaces_follow_the_name(workplace, capsys):
    for name, faces in (("scene.points.ply", False), ("scene.mesh.glb", True)):
        assert run_command(main, *USUAL[:-1], name, *(["--max-depth-jump", "0.2"] if faces else [])) == 0
        read = trimesh.load(name, force="scene").to_geometry()
        assert len(read.vertices) == 2 * 64 * 96
        assert hasattr(read, "faces") == faces
        assert f"open {name} in MeshLab" in capsys.readouterr().out


def test_portrait_images_and_another_size(workplace):
    assert run_command(main, *USUAL, "--size", "96x64", "--near", "1", "--far", "20") == 0
    assert len(read_ply(Path("scene.ply"))) == 2 * 96 * 64


def test_what_it_writes_can_be_rendered(workplace):
    assert run_command(main, *USUAL) == 0
    assert run_command(render_main, "scene.ply", "--cameras", "transforms.json", "--out", "renders") == 0
    names = {path.stem for path in Path("images").iterdir()}
    assert {path.stem for path in Path("renders").glob("*.png")} == names


def test_chosen_frames_and_cameras_written(workplace, capsys):
    assert run_command(main, *USUAL, "--select", "003,1", "--save-cameras", "used.json", "--json", "s.json") == 0
    assert json.loads(Path("s.json").read_text())["views"] == ["003.png", "001.png"]
    known = {camera.name: camera for camera in read_cameras(Path("transforms.json"))}
    for camera in read_cameras(Path("used.json")):
        np.testing.assert_allclose(camera.extrinsics, known[camera.name].extrinsics, atol=1e-12)
    assert "images used" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("frames", "numbers"),
    [
        ("0-3", [0, 1, 2, 3]),
        ("0:8:2", [0, 2, 4, 6]),
        ("5:,1", [5, 6, 7, 1]),
        ("::3", [0, 3, 6]),
        (":2", [0, 1]),
        ("4-4,6", [4, 6]),
        ("r_0.7,3-4", [7, 3, 4]),
        ("1-2", [5]),  # the image of that name
    ],
)
def test_frames_by_range(frames, numbers):
    images = [Path(name) for name in ("a.png", "b.png", "c.png", "d.png", "e.png", "1-2.png", "r_0.5", "r_0.7")]
    assert select_images(images, frames) == [images[number] for number in numbers]


def test_images_of_the_same_name_are_told_apart(workplace):
    def in_folders(content):
        content["frames"] = content["frames"][:2]
        for frame, folder in zip(content["frames"], ("left", "right"), strict=True):
            Path(folder).mkdir()
            frame["file_path"] = Path(frame["file_path"]).rename(f"{folder}/000.png").as_posix()

    change_cameras(in_folders)()
    folders = ("--save-depth", "new/depth", "--render", "new/views")
    given = ("--images", "left", "right", "--near", "1", "--far", "20")
    assert run_command(main, *USUAL[2:], *given, *folders) == 0
    names = ("left-000", "right-000")
    assert {path.name for path in Path("new/depth").iterdir()} == {
        name + end for name in names for end in (".png", ".npz")
    }
    assert {path.name for path in Path("new/views").glob("view-*")} == {f"view-{name}.png" for name in names}


def test_the_summary_on_standard_output(workplace, capsys):
    assert run_command(main, *USUAL, "--json", "-", "--save-depth", "new/depth", "--timings") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["gaussians"] == 2 * 64 * 96
    assert "wrote scene.ply" in printed.err and "open scene.ply" in printed.err
    assert not Path("-").exists()


def test_cameras_of_another_format_give_the_same(workplace):
    given = (*USUAL, "--select", "0,2", "--near", "1", "--far", "20")
    assert run_command(main, *given) == 0
    expected = read_ply(Path("scene.ply"))
    known = {camera.name: camera for camera in read_cameras(Path("transforms.json"))}
    lines = ["video"]
    for name, camera in known.items():
        Path(name).rename(Path(name).with_name(f"7{Path(name).name}"))  # timestamps do not begin with 0
        focals = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] / np.array([camera.width, camera.height] * 2)
        values = [*focals, 0, 0, *np.linalg.inv(camera.extrinsics)[:3].flat]
        lines.append(" ".join(map(str, [f"7{Path(name).stem}", *values])))
    Path("trajectory.txt").write_text("\n".join(lines))
    assert run_command(main, *given, "--cameras", "trajectory.txt") == 0
    close = np.abs(read_ply(Path("scene.ply")).means - expected.means).max(axis=1) < 1e-3
    assert close.mean() > 0.99
    assert run_command(main, *given, "--cameras", "trajectory.txt", "--camera-format", "llff") == 2


def test_a_folder_alone_is_enough(workplace, capsys):
    """Cameras beside the images, and the splats named after the folder."""
    assert run_command(main, ".", "--model", "model.onnx") == 0
    printed = capsys.readouterr().out
    out = Path(f"{workplace.name}.ply")
    assert len(read_splats(out)) == 2 * 64 * 96
    assert "cameras found beside the photographs: ." in printed and f"wrote {out}" in printed
    assert run_command(main, "images", "--model", "model.onnx", "-q") == 0
    (line,) = capsys.readouterr().out.splitlines()  # no notes
    assert line.startswith("wrote images.ply")
    assert Path("images.ply").read_bytes() == out.read_bytes()


def test_neither_images_nor_a_name_to_write(workplace, capsys):
    assert run_command(main) == 2
    assert "PHOTOS: none given" in capsys.readouterr().err
    assert run_command(main, "--cameras", "transforms.json") == 2
    assert "--out: expected the file to write" in capsys.readouterr().err


def test_a_crop_of_another_size_is_refused(workplace, capsys):
    assert run_command(main, *USUAL, "--crop", "--size", "64x96") == 2
    assert "--crop and --size: both give the size" in capsys.readouterr().err


def test_scenes_of_a_glob_are_named_after_the_folder_of_its_first_match(workplace):
    shutil.copytree("images", "photos/desk")
    assert _named_after([Path("photos/*/*.png")]) == Path("desk.ply")
    assert _named_after([Path("photos/desk")]) == Path("desk.ply")


def test_images_alone(workplace, tmp_path_factory, capsys):
    folder = tmp_path_factory.mktemp("larger")
    make_scene(folder, seed=2, views=2, height=240, width=320)
    focal = str(read_cameras(folder / "transforms.json")[0].K[0, 0])
    given = ("--images", folder / "images", "--model", "model.onnx", "--out", "scene.ply", "--cameras", "estimate")
    assert run_command(main, *given, "--focal", focal, "--save-cameras", "found.json") == 0
    printed = capsys.readouterr().out
    assert "cameras of 2 images estimated by OpenCV" in printed and "unit is the median depth" in printed
    assert "the cameras' depth ranges" in printed and "--cameras found.json" in printed
    assert len(read_ply(Path("scene.ply"))) == 2 * 64 * 96
    assert run_command(render_main, "scene.ply", "--cameras", "found.json", "--out", "renders") == 0
    assert run_command(main, *given, "--focal", focal) == 0
    printed = capsys.readouterr().out
    assert "wrote scene.cameras.json" in printed and "idesplat view scene.ply --cameras scene.cameras.json" in printed
    assert f"focal length {float(focal):.0f} pixels, of images 320 wide and 240 high" in printed
    names = [camera.name for camera in read_cameras(Path("scene.cameras.json"))]
    assert [Path(name).resolve() for name in names] == sorted((folder / "images").iterdir())  # as seen from the file
    Path("scene.ply").unlink()
    assert run_command(main, *given) == 2  # no focal length
    assert not Path("scene.ply").exists()


def test_a_video_with_cameras_that_name_its_frames(workplace):
    video = cv2.VideoWriter("clip.avi", cv2.VideoWriter_fourcc(*"MJPG"), 30, (128, 96))
    for path in sorted(Path("images").iterdir()):
        video.write(cv2.imread(str(path)))
    video.release()
    change_cameras(lambda c: [frame.update(file_path=f"clip-{i:06}.png") for i, frame in enumerate(c["frames"])])()
    assert run_command(main, *USUAL[2:], "--images", "clip.avi", "--select", "0,4", "--save-cameras", "used.json") == 0
    assert [camera.name for camera in read_cameras(Path("used.json"))] == ["clip-000000.png", "clip-000004.png"]


def change_cameras(edit):
    def change():
        content = json.loads(Path("transforms.json").read_text())
        edit(content)
        Path("transforms.json").write_text(json.dumps(content))

    return change


def nothing():
    pass


def without_fields(content, *names):
    for name in names:
        content.pop(name, None)


BAD = {
    "missing image folder": (nothing, ("--images", "nowhere"), "nowhere"),
    "unreadable image": (lambda: Path("images/000.png").write_bytes(b"not an image"), ("--select", "0,1"), "000.png"),
    "empty image": (lambda: Path("images/000.png").write_bytes(b""), ("--select", "0,1"), "000.png"),
    "corrupt JSON": (lambda: Path("transforms.json").write_text('{"frames": ['), (), "transforms.json"),
    "missing cameras": (nothing, ("--cameras", "none.json"), "none.json"),
    "missing pose": (change_cameras(lambda c: c["frames"][0].pop("transform_matrix")), (), "transform_matrix"),
    "pose of zeros": (
        change_cameras(lambda c: c["frames"][0].update(transform_matrix=[[0.0] * 4] * 4)),
        (),
        "transform_matrix",
    ),
    "NaN in a pose": (
        change_cameras(lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(3, float("nan"))),
        (),
        "transform_matrix",
    ),
    "zero focal length": (change_cameras(lambda c: c.update(fl_x=0)), (), "focal lengths are 0"),
    "negative focal length": (change_cameras(lambda c: c.update(fl_y=-300)), (), "focal lengths"),
    "one image": (lambda: [path.unlink() for path in sorted(Path("images").iterdir())[1:]], (), "at least 2"),
    "two identical cameras": (
        change_cameras(
            lambda c: [frame.update(transform_matrix=c["frames"][0]["transform_matrix"]) for frame in c["frames"]]
        ),
        (),
        "camera",
    ),
    "more images than cameras": (change_cameras(lambda c: c["frames"].pop()), (), "004"),
    "a frame that is not there": (nothing, ("--select", "000,9"), "--select 9: no image is called so"),
    "a frame twice": (nothing, ("--select", "000,0"), "names an image twice"),
    "too few frames": (nothing, ("--select", "2"), "expected at least 2"),
    "a video that is none": (lambda: Path("a.mp4").write_bytes(b"hello"), ("--images", "a.mp4"), "a.mp4"),
    "cameras of another format": (nothing, ("--camera-format", "colmap"), "COLMAP"),
    "a size it cannot take": (nothing, ("--size", "64x50"), "multiples of 16"),
    "a size that is none": (nothing, ("--size", "large"), "HEIGHTxWIDTH"),
    "near behind far": (nothing, ("--near", "5", "--far", "2"), "near < far"),
    "near behind the model's far": (nothing, ("--near", "200"), "near"),
    "NaN near": (nothing, ("--near", "nan"), "--near"),
    "a model that is not ours": (lambda: Path("model.onnx").write_bytes(b"hello"), (), "model.onnx"),
    "no model": (lambda: Path("model.onnx").unlink(), (), "model.onnx"),
    "an unknown provider": (nothing, ("--provider", "Abacus"), "Abacus"),
    "a provider that is not installed": (nothing, ("--provider", "CUDA"), "CUDA"),
    "an output folder that nobody may write to": (nothing, ("--out", "/proc/scene.ply"), "cannot write into /proc"),
    "an output folder that nobody may make": (nothing, ("--out", "/proc/a/b.ply"), "cannot write into /proc"),
    "an exposure that is none": (nothing, ("--exposure", "on"), "--exposure"),
    "a range beyond the images": (nothing, ("--select", "0-5"), "--select 0-5: no image is called so"),
    "a range that ends before it begins": (nothing, ("--select", "3-1"), "--select 3-1: no image is called so"),
    "a slice beyond the images": (nothing, ("--select", "0:9"), "--select 0:9: no image is called so"),
    "a slice without steps": (nothing, ("--select", "0:4:0"), "--select 0:4:0: no image is called so"),
    "a number that is none": (nothing, ("--select", "²,³"), "--select ²: no image is called so"),
    "a number of too many digits": (nothing, ("--select", "9" * 5000), "no image is called so"),
    "a share that is none": (nothing, ("--min-opacity", "2"), "--min-opacity 2"),
    "a surface without faint splats": (
        nothing,
        ("--out", "scene.mesh.ply", "--min-opacity", "0.1"),
        "a surface knows --max-depth-jump alone",
    ),
    "a surface with refined splats": (
        nothing,
        ("--out", "a.mesh.ply", "--refine", "10"),
        "--refine: changes Gaussians",
    ),
    "a surface with few splats": (
        nothing,
        ("--out", "a.mesh.ply", "--max-gaussians", "9"),
        "--max-gaussians: changes Gaussians",
    ),
    "a focal length beside cameras": (nothing, ("--focal", "26mm"), "--focal 26mm: is for estimated cameras"),
    "a border wider than the images": (nothing, ("--crop-border", "32"), "--crop-border 32"),
    "an output that is no splat file": (nothing, ("--out", "scene.txt"), ".ply"),
    "an output folder that is a file": (nothing, ("--save-depth", "transforms.json"), "transforms.json"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(workplace, capfd, name):
    corrupt, arguments, expected = BAD[name]
    corrupt()
    with Outputs("idesplat-infer"), atomic_write(Path("scene.ply")) as temporary:
        temporary.write_bytes(b"an earlier result")
    before = {path: path.stat().st_mtime_ns for path in workplace.rglob("*")}
    options = dict(zip(USUAL[::2], USUAL[1::2], strict=True)) | dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert run_command(main, *(part for option in options.items() for part in option)) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert expected in lines[0]
    assert {path: path.stat().st_mtime_ns for path in workplace.rglob("*")} == before
