"""Chunks and evaluation indices of the released datasets: valid ones, and damaged or malformed ones."""

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.tools.evaluation import chunks
from idesplat.tools.evaluation.chunks import IndexEntry, chunk_cases, find_chunks, read_chunk, read_index
from PIL import Image
from scene_files import as_scene

SIZE, RANGE = (64, 64), (0.5, 100.0)  # of images 96 x 128


@pytest.fixture
def folder(scene: Path, tmp_path: Path) -> Path:
    """Two chunks of two scenes each, which all show the same room."""
    for name, keys in (("000000", ("a", "b")), ("000001", ("c", "d"))):
        torch.save([as_scene(scene, key) for key in keys], tmp_path / f"{name}.torch")
    return tmp_path


def no_skip(key: str, reason: str) -> None:
    raise AssertionError(f"{key}: {reason}")


def test_cases_are_the_indexed_frames_as_the_papers_prepare_them(folder: Path, scene: Path) -> None:
    index = {"b": IndexEntry([0, 4], [1, 3]), "d": IndexEntry([1, 2, 3], [2])}
    first, second = chunk_cases(find_chunks(folder), index, SIZE, RANGE, no_skip)
    assert (first.name, first.context.names, first.targets.names) == ("b", ["0", "4"], ["1", "3"])
    assert (second.name, second.context.names, second.targets.names) == ("d", ["1", "2", "3"], ["2"])
    assert (first.near, first.far) == RANGE and first.depth is None and first.targets.valid.all()

    cameras = read_cameras(scene / "transforms.json")
    np.testing.assert_allclose(first.context.extrinsics[1], cameras[4].extrinsics, atol=1e-5)
    encoded = as_scene(scene, "")["images"][3].numpy()
    image = Image.fromarray(cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))
    expected = np.asarray(image.resize((85, 64), Image.Resampling.LANCZOS))[:, 10:74] / 255
    np.testing.assert_allclose(first.targets.image(1), expected, atol=1.5 / 255)
    assert first.targets.images.dtype == np.float32


def test_intrinsics_follow_the_crop(folder: Path, scene: Path) -> None:
    (case,) = chunk_cases(find_chunks(folder), {"a": IndexEntry([0, 1], [2])}, SIZE, RANGE, no_skip)
    K = read_cameras(scene / "transforms.json")[2].K
    x, y, _ = K @ (0.1, -0.05, 1)  # in the image
    expected = x * 85 / 128 - 10, y * 64 / 96  # scaled to 85 x 64, cut from column 10
    np.testing.assert_allclose((case.targets.K(0) @ (0.1, -0.05, 1))[:2], expected, atol=1e-4)


def test_reads_a_published_index(tmp_path: Path) -> None:
    path = tmp_path / "index.json"
    path.write_text('{"x": null, "5aca87f95a9412c6": {"context": [58, 133], "target": [84, 102, 129]}}')
    assert read_index(path) == {"5aca87f95a9412c6": IndexEntry([58, 133], [84, 102, 129])}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ('{"a": ', "not valid JSON"),
        ("[1]", "list"),
        ("{}", "no scene"),
        ('{"a": null}', "no scene"),
        ('{"a": "000000.torch", "b": "000001.torch"}', "lists chunk files"),
        ('{"a": {"context": [0, 1]}}', "a: expected"),
        ('{"a": {"context": [], "target": [1]}}', "a: expected"),
        ('{"a": {"context": [0, -1], "target": [1]}}', "a: expected"),
        ('{"a": {"context": [0, 1.5], "target": [1]}}', "a: expected"),
        ('{"a": {"context": [0, true], "target": [1]}}', "a: expected"),
        ('{"a": [0, 1]}', "a: expected"),
    ],
)
def test_refuses_files_that_are_no_index(content: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "index.json"
    path.write_text(content)
    with pytest.raises(InputError, match=expected) as error:
        read_index(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_finds_chunks_or_names_the_folder_that_has_them(folder: Path, tmp_path: Path) -> None:
    assert [path.name for path in find_chunks(folder)] == ["000000.torch", "000001.torch"]
    root = tmp_path / "dataset"
    root.mkdir()
    with pytest.raises(InputError, match=r"no \.torch chunks"):
        find_chunks(root)
    (root / "test").mkdir()
    (root / "test" / "000000.torch").write_bytes(b"")
    with pytest.raises(InputError, match=r"such as .*test"):
        find_chunks(root)
    with pytest.raises(InputError, match="no such folder"):
        find_chunks(root / "train")


class MaliciousPickle:
    """An object whose pickle runs code when it is loaded without restrictions."""

    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> tuple[Callable, tuple]:
        return Path.touch, (self.victim,)


def test_never_runs_code(tmp_path: Path) -> None:
    victim, torch_file, pickle_file = tmp_path / "victim", tmp_path / "0.torch", tmp_path / "1.torch"
    torch.save([{"key": MaliciousPickle(victim)}], torch_file)
    pickle_file.write_bytes(pickle.dumps([MaliciousPickle(victim)]))
    for path in (torch_file, pickle_file):
        with pytest.raises(InputError, match="damaged or holds more than data") as error:
            read_chunk(path)
        assert "\n" not in str(error.value)
    assert not victim.exists()


def change(field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda scene: scene.__setitem__(field, value)


BAD = {
    "no key": (lambda scene: scene.pop("key"), "key"),
    "a key that leads elsewhere": (change("key", "../a"), "key"),
    "no cameras": (lambda scene: scene.pop("cameras"), "cameras is no dense tensor"),
    "short rows": (lambda scene: scene.update(cameras=scene["cameras"][:, :17]), r"cameras is float32 \[5, 17\]"),
    "whole numbers": (lambda scene: scene.update(cameras=scene["cameras"].int()), "cameras is int32"),
    "bfloat16": (lambda scene: scene.update(cameras=scene["cameras"].bfloat16()), "cameras is no dense tensor"),
    "sparse": (lambda scene: scene.update(cameras=scene["cameras"].to_sparse()), "cameras is no dense tensor"),
    "a gradient": (lambda scene: scene["cameras"].requires_grad_(), "cameras is no dense tensor"),
    "no values": (lambda scene: scene.update(cameras=scene["cameras"].to("meta")), "cameras is no dense tensor"),
    "an image without values": (
        change("images", [torch.zeros(9, dtype=torch.uint8, device="meta")] * 5),
        r"images\[0\]",
    ),
    "a sparse image": (change("images", [torch.ones(9, dtype=torch.uint8).to_sparse()] * 5), r"images\[0\]"),
    "a byte repeated": (change("images", [torch.zeros(1, dtype=torch.uint8).expand(10**12)] * 5), r"images\[0\]"),
    "no images": (lambda scene: scene.pop("images"), "images is NoneType"),
    "fewer images": (lambda scene: scene["images"].pop(), "images is 4, expected one for each of 5"),
    "decoded images": (change("images", [torch.zeros(3, 4, 4)] * 5), r"images\[0\]"),
    "bytes": (change("images", [b"jpeg"] * 5), r"images\[0\]"),
}


@pytest.mark.parametrize("name", BAD)
def test_refuses_malformed_scenes(name: str, scene: Path, tmp_path: Path) -> None:
    damage, expected = BAD[name]
    content = as_scene(scene, "a")
    damage(content)
    path = tmp_path / "0.torch"
    torch.save([as_scene(scene, "b"), content], path)
    with pytest.raises(InputError, match=expected) as error:
        read_chunk(path)
    assert f"{path}: scene 1" in str(error.value)


@pytest.mark.parametrize("content", [{"key": "a"}, [torch.zeros(3)], torch.zeros(3)])
def test_refuses_chunks_without_a_list_of_scenes(content: Any, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "0.torch")
    with pytest.raises(InputError, match="expected a list of scenes"):
        read_chunk(tmp_path / "0.torch")


def test_refuses_damaged_chunks(folder: Path) -> None:
    path = folder / "000000.torch"
    whole = path.read_bytes()
    for content in (b"", b"not a chunk", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            read_chunk(path)


def test_a_packed_chunk_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "packed.torch"
    torch.save([{"key": "a", "cameras": torch.zeros(1 << 20)}], tmp_path / "plain.pth")
    with zipfile.ZipFile(tmp_path / "plain.pth") as plain, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    with pytest.raises(InputError, match="claims to hold"):
        read_chunk(path)


def test_an_index_of_another_dataset(folder: Path) -> None:
    with pytest.raises(InputError, match="scene c has 5 frames and the index asks for number 58"):
        list(chunk_cases(find_chunks(folder), {"c": IndexEntry([0, 58], [1])}, SIZE, RANGE, no_skip))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda scene: scene["images"].__setitem__(1, scene["images"][1][:300]), "frame 1: .*decoded"),
        (lambda scene: scene["images"].__setitem__(1, torch.zeros(99, dtype=torch.uint8)), "frame 1: .*decoded"),
        (lambda scene: scene["cameras"][2].fill_(float("nan")), "frame 2: "),
        (lambda scene: scene["cameras"][2, 6:].mul_(3), "frame 2: .*scaled"),
        (lambda scene: scene["cameras"][2, :4].mul_(1000), "frame 2: .*focal"),
    ],
)
def test_skips_scenes_that_are_damaged(damage: Callable, expected: str, scene: Path, tmp_path: Path) -> None:
    content = as_scene(scene, "a")
    damage(content)
    torch.save([content, as_scene(scene, "b")], tmp_path / "0.torch")
    skipped: dict[str, str] = {}
    index = {key: IndexEntry([0, 1], [2]) for key in "ab"}
    (case,) = chunk_cases(find_chunks(tmp_path), index, SIZE, RANGE, skipped.__setitem__)
    assert case.name == "b" and list(skipped) == ["a"]
    with pytest.raises(InputError, match=expected):
        raise InputError(skipped["a"])


def test_missing_torch_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "find_spec", lambda package: None)
    with pytest.raises(InputError, match=r"PyTorch is needed.*pip install"):
        read_chunk(folder / "000000.torch")
