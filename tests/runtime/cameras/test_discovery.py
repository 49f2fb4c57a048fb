"""Cameras beside images of which nothing else is known."""

import shutil
from pathlib import Path

import pytest
from idesplat.runtime.cameras.discovery import find_cameras
from idesplat.runtime.cameras.io import read_cameras, write_cameras
from PIL import Image
from scene_files import pinholes


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """`room/images` with two images, and we stand beside it."""
    monkeypatch.chdir(tmp_path)
    images = Path("room/images")
    images.mkdir(parents=True)
    for name in ("a.png", "b.png"):
        Image.new("RGB", (16, 16)).save(images / name)
    return images


def write_transforms(path: Path) -> None:
    write_cameras(path, pinholes(["images/a.png", "images/b.png"]))


def write_colmap(model: Path) -> None:
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 16 16 20 20 8 8\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n\n2 1 0 0 0 1 0 1 1 b.png\n\n")
    (model / "points3D.txt").write_text("")


def test_transforms_beside_the_folder_of_images(folder):
    write_transforms(Path("room/transforms.json"))
    for given in ([folder], [Path("room")], [folder / "a.png", folder / "b.png"], [Path("room/images/*.png")]):
        found = find_cameras(given)
        assert found.cameras == Path("room") and "room" in found.note
        assert len(read_cameras(found.cameras)) == 2
    assert find_cameras([Path("room")]).images == [folder]


def test_transforms_among_the_images(folder):
    write_transforms(folder / "transforms.json")
    write_transforms(Path("room/transforms.json"))
    assert find_cameras([folder]).cameras == folder


def test_a_model_of_colmap(folder):
    write_colmap(Path("room/sparse/0"))
    assert find_cameras([folder]).cameras == Path("room")


def test_own_file(folder):
    write_transforms(Path("room/cameras.json"))
    assert find_cameras([folder]).cameras == Path("room/cameras.json")


def test_none(folder):
    Path("room/transforms.txt").write_text("notes")
    Path("room/cameras.json").write_text("{}")
    found = find_cameras([folder])
    assert found.cameras is None and found.images == [folder] and "estimated" in found.note


def test_from_inside_the_folder(folder, monkeypatch):
    write_transforms(Path("room/transforms.json"))
    monkeypatch.chdir(folder)
    assert find_cameras([Path()]).cameras == Path("..")
    assert find_cameras([Path("a.png")]).cameras == Path("..")


def test_a_video_has_cameras_of_its_name_alone(folder):
    write_transforms(Path("room/transforms.json"))
    video = Path("room/clip.mp4")
    video.touch()
    assert find_cameras([video]).cameras is None
    shutil.copy("room/transforms.json", "room/clip.json")
    assert find_cameras([video]).cameras == Path("room/clip.json")
