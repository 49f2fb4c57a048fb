"""No command replaces what it reads, another of its outputs, or a file that no command wrote."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.io import write_cameras
from idesplat.runtime.cli.cameras import main as cameras_main
from idesplat.runtime.cli.convert import main as convert
from idesplat.runtime.cli.infer import main as infer
from idesplat.runtime.cli.outputs import write_json
from idesplat.runtime.cli.render import main as render
from idesplat.runtime.cli.view import main as view
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.naming import name_files
from idesplat.runtime.system.files import atomic_write
from idesplat.runtime.system.output_records import LEAST_STALE_LINES, read_record
from idesplat.runtime.system.outputs import Outputs, outputs
from scene_files import pinholes, snapshot, write_scene

FIRST, SECOND = "000.png", "001.png"


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    """A folder with two images, their cameras, a scene, and something of the user's; we stand in it."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    rng = np.random.default_rng(0)
    for name in (FIRST, SECOND):
        cv2.imwrite(f"images/{name}", rng.integers(0, 255, (16, 16, 3), np.uint8))
    write_cameras(Path("transforms.json"), pinholes([f"images/{name}" for name in (FIRST, SECOND)]))
    write_scene(Path("scene.ply"))
    Path("notes.json").write_text("the user's own")
    return tmp_path


def refused(capfd, folder, main, *arguments):
    """The one line with which a command refuses, after having left everything as it was."""
    before = snapshot(folder)
    capfd.readouterr()
    assert run_command(main, *arguments) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ")
    assert snapshot(folder) == before
    return lines[0]


# ---- idesplat render: seven ways to say where the images are


def as_folder(dataset):
    return dataset.resolve(), dataset / "images"


def as_names_without_suffix(dataset):
    write_cameras(dataset / "transforms.json", pinholes(["images/000", "images/001"]))
    return dataset / "transforms.json", Path("images")


def as_colmap(dataset):
    model = dataset / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 16 16 16 16 8 8\n")
    (model / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 0 0 0 1 00{i}.png\n\n" for i in range(2)))
    (model / "points3D.txt").write_text("")
    return model, dataset / "images"


def as_another_folder_that_is_read(dataset):
    """Where idesplat-infer without --images finds them."""
    (dataset / "images").rename("blended_images")
    write_cameras(dataset / "transforms.json", pinholes([FIRST, SECOND]))
    return dataset / "transforms.json", Path("blended_images")


def as_own_json_elsewhere(dataset):
    (dataset / "elsewhere").mkdir()
    write_cameras(dataset / "elsewhere" / "cameras.json", pinholes([FIRST, SECOND]))
    return Path("elsewhere/cameras.json"), Path("images")


def as_file_and_link(dataset):
    (dataset / "link").symlink_to("images")
    return dataset / "transforms.json", Path("link")


def as_hard_links(dataset):
    (dataset / "linked").mkdir()
    for name in (FIRST, SECOND):
        os.link(dataset / "images" / name, dataset / "linked" / name)
    return dataset / "transforms.json", Path("linked")


def as_relative_folder(dataset):
    return Path(), Path("images")


RENDERS = [
    as_folder,
    as_names_without_suffix,
    as_colmap,
    as_another_folder_that_is_read,
    as_own_json_elsewhere,
    as_file_and_link,
    as_hard_links,
    as_relative_folder,
]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("way", RENDERS)
def test_render_never_replaces_images(dataset, capfd, way, overwrite):
    if way is as_colmap:
        pytest.importorskip("pycolmap")
    cameras, out = way(dataset)
    if overwrite and way is as_own_json_elsewhere:
        return  # nothing says where these images are, and the user wants to replace them
    options = ["--overwrite"] if overwrite else []
    line = refused(capfd, dataset, render, "scene.ply", "--cameras", cameras, "--out", out, "--depth", *options)
    assert "would replace an image" in line or (not overwrite and "idesplat did not write it" in line)


def test_render_never_replaces_a_named_image(dataset, capfd):
    shutil.copy("images/000.png", "mine.png")
    assert "mine.png: exists" in refused(capfd, dataset, render, "scene.ply", "--out", "mine.png")


def test_render_again_and_over(dataset, capfd):
    """Its own output is replaced; a file changed since, only with --overwrite."""
    given = ("scene.ply", "--cameras", "transforms.json", "--out", "renders")
    assert run_command(render, *given) == run_command(render, *given) == 0
    Path("renders/001.png").write_bytes(b"touched up by hand")
    assert "renders/001.png: exists" in refused(capfd, dataset, render, *given)
    assert run_command(render, *given, "--overwrite") == 0
    assert Path("renders/001.png").read_bytes().startswith(b"\x89PNG")
    assert run_command(render, *given) == 0


def test_render_beside_its_cameras_again(dataset):
    """Its own renderings in a folder of images do not count as input images."""
    shutil.move("transforms.json", "images/cameras.json")
    given = ("scene.ply", "--cameras", "images/cameras.json", "--out", "images/images")
    write_cameras(Path("images/cameras.json"), pinholes(["000.jpg", "001.jpg"]))
    assert run_command(render, *given) == run_command(render, *given) == 0


# ---- idesplat-infer


@pytest.fixture
def workplace(dataset, exported):
    shutil.copy(exported[0], "model.onnx")
    return dataset


USUAL = {"--images": "images", "--cameras": "transforms.json", "--model": "model.onnx", "--out": "new.ply"}
INFERS = {
    "depth maps over images": (
        {"--save-depth": "images", "--near": "1", "--far": "9"},
        "would replace an image",
    ),
    "summary over cameras": ({"--json": "transforms.json"}, "would replace the cameras"),
    "report over cameras": ({"--report": "./images/../transforms.json"}, "would replace the cameras"),
    "cameras over cameras": ({"--save-cameras": "transforms.json"}, "would replace the cameras"),
    "splats over the model": ({"--model": "model.ply", "--out": "model.ply"}, "would replace the model"),
    "summary over splats": ({"--json": "new.ply"}, "--json new.ply: is also the file of --out"),
    "summary over splats in other letters": ({"--json": "NEW.ply"}, "--json NEW.ply: is also the file of --out"),
    "report over an image": ({"--report": "images/000.png"}, "would replace an image"),
    "a file where a folder is to be": ({"--save-depth": "new.ply"}, "--save-depth new.ply"),
    "a folder in a file": ({"--render": "new.ply/views"}, "new.ply is the file of --out"),
}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", INFERS)
def test_infer_never_replaces_what_it_reads(workplace, capfd, name, overwrite):
    shutil.copy("model.onnx", "model.ply")
    options, expected = INFERS[name]
    given = [part for option in (USUAL | options).items() for part in option] + ["--overwrite"] * overwrite
    assert expected in refused(capfd, workplace, infer, *given)


@pytest.mark.parametrize("option", [("--save-depth", "images"), ("--report", "images/001.png")])
@pytest.mark.parametrize("way", [as_names_without_suffix, as_own_json_elsewhere])
def test_infer_never_replaces_images_that_only_the_cameras_name(dataset, capfd, way, option):
    cameras, _ = way(dataset)
    given = ["--cameras", cameras, "--out", "new.ply", "--near", "1", "--far", "9"]  # the bundled model
    assert "would replace an image" in refused(capfd, dataset, infer, *given, *option, "--overwrite")


@pytest.mark.posix
def test_infer_leaves_what_is_not_its_own(workplace, capfd):
    given = [part for option in USUAL.items() for part in option]
    line = refused(capfd, workplace, infer, *given, "--json", "notes.json")
    assert "--json notes.json: exists" in line and "--overwrite" in line
    Path("new.splat").write_bytes(b"from another program")
    assert "new.splat: exists" in refused(capfd, workplace, infer, *given, "--out", "new.splat")
    Path("link.ply").symlink_to("notes.json")
    assert "link.ply: exists" in refused(capfd, workplace, infer, *given, "--out", "link.ply")
    Path("nowhere.ply").symlink_to("not there")
    assert "nowhere.ply: exists" in refused(capfd, workplace, infer, *given, "--out", "nowhere.ply")


# ---- the other commands


def test_other_commands_leave_what_is_not_theirs(dataset, capfd):
    Path("a.splat").write_bytes(b"from another program")
    assert "a.splat: exists" in refused(capfd, dataset, convert, "scene.ply", "a.splat")
    assert "would replace the scene" in refused(capfd, dataset, convert, "scene.ply", "./scene.ply", "--overwrite")
    os.link("scene.ply", "same.ply")
    assert "would replace the scene" in refused(capfd, dataset, convert, "scene.ply", "same.ply", "--overwrite")
    assert run_command(convert, "scene.ply", "a.splat", "--overwrite") == 0
    assert run_command(convert, "scene.ply", "a.splat") == 0

    assert "notes.json: exists" in refused(capfd, dataset, cameras_main, "convert", "transforms.json", "notes.json")
    assert run_command(cameras_main, "convert", "transforms.json", "new/folder/cameras.json") == 0

    Path("page.html").write_text("the user's own")
    assert "page.html: exists" in refused(capfd, dataset, view, "scene.ply", "--html", "page.html")


def test_a_scene_is_made_only_over_its_own(tmp_path, capfd):
    from idesplat.tools.synthetic.make_scene import main as make_scene

    given = (tmp_path / "room", "--views", 2, "--width", 32, "--height", 32)
    assert run_command(make_scene, *given) == run_command(make_scene, *given) == 0
    (tmp_path / "room" / "transforms.json").write_text("changed by hand")
    assert "transforms.json: exists" in refused(capfd, tmp_path, make_scene, *given)


def test_evaluation_leaves_images_of_others(dataset, exported, capfd):
    from idesplat.tools.evaluation.cli import main as evaluate

    given = ("scene", "images", "--cameras", "transforms.json", "--model", exported[0])
    assert "would replace data" in refused(capfd, dataset, evaluate, *given, "--out", "images", "--overwrite")
    Path("results").mkdir()
    Path("results/results.json").write_text("the user's own")
    assert "results.json: exists" in refused(capfd, dataset, evaluate, *given, "--out", "results")


def test_training_leaves_what_is_not_its_own(tmp_path, capfd):
    from idesplat.tools.training.cli import main as train

    out = tmp_path / "run"
    out.mkdir()
    (out / "log.jsonl").write_text("the user's own")
    assert "log.jsonl: exists" in refused(capfd, tmp_path, train, "--out", out)
    (out / "log.jsonl").unlink()
    (out / "last.ckpt").write_bytes(b"a checkpoint")
    line = refused(capfd, tmp_path, train, "--out", out, "--init", out / "last.ckpt")
    assert "would replace the checkpoint to start from" in line


def test_an_export_leaves_what_is_not_its_own(tmp_path, small_checkpoint, presets, capfd):
    from idesplat.export.cli import main as export

    (tmp_path / "model.onnx").write_bytes(b"from another program")
    assert "model.onnx: exists" in refused(capfd, tmp_path, export, small_checkpoint, tmp_path / "model.onnx")
    shutil.copy(small_checkpoint, tmp_path / "idesplat-small.onnx")
    checkpoint = tmp_path / "idesplat-small.onnx"
    assert "would replace the checkpoint" in refused(capfd, tmp_path, export, checkpoint, checkpoint, "--overwrite")


def test_a_benchmark_leaves_what_is_not_its_own(dataset, exported, capfd):
    from idesplat.tools.benchmark.cli import main as bench

    assert "notes.json: exists" in refused(capfd, dataset, bench, exported[0], "--json", "notes.json")
    assert "would replace" in refused(capfd, dataset, bench, exported[0], "--json", exported[0], "--overwrite")


# ---- the rule itself


def test_what_was_not_announced_is_checked_when_it_is_written(tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("the user's own")
    with pytest.raises(InputError, match="exists"), Outputs("test"), atomic_write(mine) as temporary:
        temporary.write_text("lost")
    assert mine.read_text() == "the user's own"
    with atomic_write(mine) as temporary:  # a library, not a command
        temporary.write_text("as the caller wants")
    assert mine.read_text() == "as the caller wants"


def write(path, text="something"):
    with atomic_write(path) as temporary:
        temporary.write_text(text)


def test_a_record_of_what_was_written(tmp_path):
    path = tmp_path / "a.txt"
    with Outputs("one"):
        write(path)
    run = Outputs("two")
    assert run.writer_of(path) == "one"
    run.writes("--out", [path])
    moved = path.rename(tmp_path / "b.txt")
    assert Outputs("two").writer_of(moved) is None
    with Outputs("one"):
        write(path)
    status = path.stat()
    path.write_text("somethinG")  # of the same length
    assert Outputs("two").writer_of(path) is None or status.st_mtime_ns == path.stat().st_mtime_ns
    path.touch()
    with pytest.raises(InputError, match=r"a\.txt: exists"):
        Outputs("two").writes("--out", [path])


def test_without_a_cache_folder_files_are_kept(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    for place in (tmp_path / "file", tmp_path / "cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(place))
        with Outputs("one"):
            write(tmp_path / f"{place.name}.txt")
    assert Outputs("two").writer_of(tmp_path / "file.txt") is None
    assert Outputs("two").writer_of(tmp_path / "cache.txt") == "one"
    shutil.rmtree(tmp_path / "cache")
    assert Outputs("two").writer_of(tmp_path / "cache.txt") is None


@pytest.mark.posix
def test_a_damaged_or_long_record(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out = tmp_path / "out"
    out.mkdir()
    with Outputs("one"):
        write(out / "a.txt")
        write(out / "b.txt")
    (record,) = (tmp_path / "cache").rglob("*.jsonl")
    whole = record.read_text()
    for damage in ("", "{", '["a.txt"]', '["a.txt", 1, "x", 3]', "null", "\xff\x00", "[" * 5000):
        record.write_text(whole + damage + "\n", encoding="latin-1")
        assert set(read_record(out)) == {"a.txt", "b.txt"}
    record.write_text(whole * LEAST_STALE_LINES)
    assert set(read_record(out)) == {"a.txt", "b.txt"}
    assert record.read_text() == whole
    record.unlink()
    os.mkfifo(record)
    assert read_record(out) == {}
    with Outputs("one"):
        write(out / "c.txt")


@pytest.mark.posix
def test_devices_and_impossible_names_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("link").symlink_to("/dev/null")
    run = Outputs("test", overwrite=True)
    for name in ("pipe", "/dev/null", "link"):
        with pytest.raises(InputError, match="is a device or a pipe"):
            run.writes("--json", [Path(name)])
    with pytest.raises(InputError, match="is a folder"):
        run.writes("--json", [tmp_path])
    for name in ("a\0b", "a\ud800b"):
        with pytest.raises(InputError, match="no file can have this name"):
            run.writes("--json", [Path(name)])
    with pytest.raises(InputError, match="cannot be written"):
        run.writes("--json", [Path("a" * 300)])


def test_inputs_that_are_known_later(tmp_path):
    run = Outputs("test", overwrite=True)
    run.writes("--out", [tmp_path / "a.png"])
    with pytest.raises(InputError, match=r"--out .*a\.png: would replace an image"):
        run.reads("an image", [tmp_path / "b" / ".." / "a.png"])
    run.reads("an image", [tmp_path / "b.png"])
    with pytest.raises(InputError, match="would replace an image"):
        run.writes("--out", [tmp_path / "b.png"])  # though neither exists


def test_outside_of_a_command_nothing_is_kept(tmp_path, capsys):
    assert outputs() is not outputs()
    write_json(tmp_path / "a.json", "{}")
    assert json.loads((tmp_path / "a.json").read_text()) == {}
    assert Outputs("test").writer_of(tmp_path / "a.json") is None


@pytest.mark.parametrize(
    ("images", "endings", "expected"),
    [
        (["images/a.png", "images/b.jpg"], ("",), ["a", "b"]),
        (["r_0.5", "r_0.7"], ("",), ["r_0.5", "r_0.7"]),
        (["a.png", "a.jpg", "0-a.png"], ("",), ["0-a", "1-a", "2-0-a"]),
        (["x/left/1.png", "x/right/1.png"], ("",), ["left-1", "right-1"]),
        (["../left/1.png", "/right/1.png", "1.png"], ("",), ["left-1", "right-1", "1"]),
        (["left\\1.png", "LEFT/1.png"], ("",), ["0-1", "1-1"]),
        (["caf\u00e9.png", "cafe\u0301.png"], ("",), ["0-caf\u00e9", "1-cafe\u0301"]),
        (["a", "a-depth"], ("", "-depth"), ["0-a", "1-a-depth"]),
        (["", "."], ("",), ["0-image", "1-image"]),
        ([f"{i % 2}.png" for i in range(12)], ("",), [f"{i:02}-{i % 2}" for i in range(12)]),
    ],
)
def test_names_of_files(images, endings, expected):
    assert name_files(images, endings) == expected


# ---- a wrong file: the message lists what is read


@pytest.mark.parametrize(
    ("main", "arguments", "expected"),
    [
        (infer, ("--images", "transforms.json", "--cameras", "transforms.json"), (".jpg", ".png", ".webp")),
        (infer, ("--images", "images", "--cameras", "images/000.png"), ("transforms.json", "COLMAP", "RealEstate10K")),
        (infer, ("--images", "images", "--cameras", "images"), ("transforms.json", "COLMAP", "poses_bounds.npy")),
        (render, ("images/000.png",), (".ply", ".splat", ".spz", ".sog", ".glb")),
        (render, ("scene.ply", "--cameras", "images/000.png"), ("transforms.json", "COLMAP", "RealEstate10K")),
        (convert, ("images/000.png",), (".ply", ".splat", ".spz", ".sog", ".glb")),
        (view, ("images/000.png",), (".ply", ".splat", ".spz", ".sog", ".glb")),
        (view, ("scene.ply", "--cameras", "transforms.json", "--images", "scene.ply"), (".jpg", ".png", ".webp")),
        (cameras_main, ("convert", "scene.ply"), ("transforms.json", "COLMAP", "RealEstate10K")),
    ],
)
def test_a_wrong_file_is_told_what_is_read(dataset, capfd, main, arguments, expected):
    out = {convert: ["new.ply"], cameras_main: ["new.json"], view: ["--html", "new.html"], infer: ["--out", "new.ply"]}
    line = refused(capfd, dataset, main, *arguments, *out.get(main, ["--out", "new"]))
    assert all(text in line for text in expected)
    assert main not in (convert, render, view) or ".obj" not in line  # which is written, not read
