"""Readers of any content return valid values or raise a one-line InputError. See docs/security.md."""

import json
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
from camera_cases import known
from conftest import SMALL
from hypothesis import given
from hypothesis import strategies as st
from idesplat import Predictor
from idesplat.export.existing_exports import foreign_entries, is_our_graph
from idesplat.model.checkpoint import CheckpointError, read_state_dict
from idesplat.runtime.cameras.io import CameraFormat, read_cameras, write_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.exif import exif_focal, parse_focal
from idesplat.runtime.images.header import image_size
from idesplat.runtime.images.io import load_image
from idesplat.runtime.images.sizes import parse_size
from idesplat.runtime.images.video_reader import extract_sharp_frames
from idesplat.runtime.inference.metadata import MANIFEST_NAME, METADATA_KEY, StageFile, read_manifest, write_manifest
from idesplat.runtime.system.output_records import add_to_record, read_record
from idesplat.runtime.views.depth_range import DepthRange
from idesplat.runtime.views.world_offset import parse_offset
from idesplat.tools.benchmark.report import Row, read_rows
from idesplat.tools.evaluation.captures import capture as captures
from idesplat.tools.evaluation.captures.capture import parse_view_counts, read_captures
from idesplat.tools.evaluation.chunks import chunk_cases, read_chunk, read_index
from idesplat.tools.evaluation.image_folders import load_case
from idesplat.tools.training.log import TrainingLog
from idesplat.tools.training.plots import write_curves
from idesplat.tools.training.state import TrainingState
from mutations import TEXTS, mutated, mutated_json, tried
from PIL import Image
from safetensors.torch import save_file
from scene_files import HEIC, as_scene
from tiny_model import write_model

SIZE = (64, 64)
IMAGES = ("png", "jpg", "tif", "webp", "bmp", "avif", "jp2", "ppm", "heic")
SETTINGS = {"preset": "small"}


class Target:
    """A good file, what reads it, and its content as JSON where it is that."""

    def __init__(self, name: str, content: bytes, read: Callable[[Path], Any], document: Any = None) -> None:
        self.name, self.content, self.read, self.document = name, content, read, document


def saved(write: Callable[[Path], Any], path: Path) -> bytes:
    write(path)
    return path.read_bytes()


def image_of(kind: str) -> bytes:
    if kind == "heic":
        return HEIC.read_bytes()
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    exif = Image.Exif()
    exif[274] = 6
    written = BytesIO()
    form = {"jpg": "JPEG", "tif": "TIFF", "jp2": "JPEG2000"}.get(kind, kind.upper())
    Image.fromarray(pixels).save(written, form, **({"exif": exif} if kind in ("jpg", "png", "webp", "tif") else {}))
    return written.getvalue()


def read_image(path: Path) -> None:
    size = None
    try:
        size = image_size(path)
        exif_focal(path, *size)
    finally:  # the pixels, too, where the header is refused
        try:
            pixels = load_image(path)
        except InputError as error:
            assert_one_line(error, path)
        else:
            assert pixels.dtype == np.uint8 and pixels.shape[2] == 3
            assert size is not None and pixels.shape[:2] == size[::-1]


def read_video(path: Path) -> None:
    folder = path.with_name("frames")
    folder.mkdir()
    try:
        assert extract_sharp_frames(path, folder)
    finally:
        shutil.rmtree(folder)


def read_depth(pairs: list, path: Path) -> None:
    found = DepthRange(1.0, 10.0, "given")
    case = load_case(pairs, [0, 1], [2], (32, 48), lambda views: found, path.parent)
    assert case.depth.shape == (2, 32, 48)


def read_scene_of_chunk(path: Path) -> None:
    index = {scene["key"]: entry for scene, entry in zip(read_chunk(path), [ENTRY] * 9, strict=False)}
    for case in chunk_cases([path], index, SIZE, (0.5, 100.0), lambda key, reason: None):
        assert np.isfinite(case.context.images).all()


class FewWeights(torch.nn.Module):
    """In place of a network, of whose checkpoint the 5,000 tensors take a second to read."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = torch.nn.Linear(3, 4)
        self.gaussians = torch.nn.Conv2d(2, 3, 3)


def resume(state: TrainingState, path: Path) -> None:
    before = {name: value.clone() for name, value in state.ema.items()}
    try:
        state.resume(path, SETTINGS)
    except BaseException:
        for name, value in state.ema.items():  # half of another run's state would be lost work
            torch.testing.assert_close(value, before[name], equal_nan=True)
        raise


def run_model(path: Path) -> None:
    Predictor(path)


def read_written(path: Path) -> None:
    """The record of the files in a folder, which is read from the cache."""
    (record,) = (Path(os.environ["XDG_CACHE_HOME"]) / "idesplat" / "written").iterdir()
    shutil.copy(path, record)
    read_record(path.parent)


ENTRY: Any = None  # of an index, set below
JSON = json.JSONDecoder().decode


@pytest.fixture(scope="module")
def targets(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    """A good file of every kind, and its reader."""
    global ENTRY
    from idesplat.tools.evaluation.chunks import IndexEntry

    ENTRY = IndexEntry([0, 4], [1])
    folder = tmp_path_factory.mktemp("good")
    found = [Target(f"image.{kind}", image_of(kind), read_image) for kind in IMAGES]

    writer = cv2.VideoWriter(str(folder / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (48, 32))
    for grey in range(12):
        writer.write(np.full((32, 48, 3), 20 * grey, np.uint8))
    writer.release()
    found.append(Target("clip.avi", (folder / "clip.avi").read_bytes(), read_video))

    cameras = known(["a.png", "b.png"], distortion=(0.1, -0.05, 0.001, 0.002), fisheye=False)
    for name in ("transforms.json", "own.json"):
        content = saved(lambda path: write_cameras(path, cameras), folder / name)
        found.append(Target(name, content, read_some_cameras, JSON(content.decode())))

    stages = [StageFile("a", "a.onnx", ["images"], ["x"]), StageFile("b", "b.onnx", ["x"], ["depth"])]
    write_manifest(folder, stages)
    content = (folder / MANIFEST_NAME).read_bytes()
    found.append(Target(MANIFEST_NAME, content, read_staged, JSON(content.decode())))
    found.append(Target("model.onnx", saved(write_model, folder / "model.onnx"), run_model))
    found.append(Target("old.onnx", found[-1].content, is_our_graph))

    weights = {"encoder.a": torch.arange(12.0).reshape(3, 4), "encoder.b": torch.ones(2, dtype=torch.float16)}
    pickled = {"state_dict": weights, "epoch": 3}
    legacy = partial(torch.save, _use_new_zipfile_serialization=False)
    found.append(Target("a.ckpt", saved(partial(torch.save, pickled), folder / "a.ckpt"), read_state_dict))
    found.append(Target("old.pth", saved(partial(legacy, pickled), folder / "old.pth"), read_state_dict))
    tensors = saved(partial(save_file, weights), folder / "a.safetensors")
    found.append(Target("a.safetensors", tensors, read_state_dict))

    chunk = saved(partial(torch.save, [as_scene(scene, "a")]), folder / "0.torch")
    found.append(Target("0.torch", chunk, read_scene_of_chunk))
    index = {"a": {"context": [0, 4], "target": [1]}, "b": None}
    found.append(Target("index.json", json.dumps(index).encode(), read_index, index))
    document = JSON(captures.CAPTURES_FILE.read_text())
    document["captures"] = document["captures"][:1]
    found.append(Target("captures.json", json.dumps(document).encode(), read_capture_file, document))
    rows = {"version": 2, "machine": {}, "rows": [asdict(Row("m", "p", "float32", "CPU", 2, 32, 48, seconds=[1.0]))]}
    found.append(Target("rows.json", json.dumps(rows).encode(), read_rows, rows))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("idesplat.tools.training.state.new_model", lambda config, seed: FewWeights())
        state = TrainingState(SMALL, 0, 1e-3, 1e-3)
    content = saved(partial(state.save, settings=SETTINGS), folder / "last.ckpt")
    found.append(Target("last.ckpt", content, partial(resume, state)))
    log = b'{"step": 1, "loss": 1.5}\n{"step": 2, "loss": 1.25}\n'
    found.append(Target("log.jsonl", log, read_log, JSON(log.decode().splitlines()[0])))

    np.savez_compressed(folder / "000.npz", depth=np.full((96, 128), 3.0, np.float32))
    pairs = [(scene / camera.name, camera) for camera in read_cameras(scene / "transforms.json")]
    shutil.copy(folder / "000.npz", folder / "001.npz")
    found.append(Target("000.npz", (folder / "000.npz").read_bytes(), partial(read_depth, pairs)))
    return {target.name: target for target in found}


def read_some_cameras(path: Path) -> None:
    for form in (None, CameraFormat.OWN, CameraFormat.TRANSFORMS):
        try:
            cameras = read_cameras(path, (), form)
        except InputError as error:
            assert_one_line(error, path)
            continue
        for camera in cameras:
            assert np.isfinite(camera.K).all() and np.isfinite(camera.extrinsics).all()


def read_staged(path: Path) -> None:
    """The manifest as the predictor reads it, and as the exporter asks whether the folder is its own."""
    for name in ("a.onnx", "b.onnx"):
        (path.parent / name).touch()
    foreign_entries(path.parent)
    read_manifest(path.parent)


def read_capture_file(path: Path) -> None:
    for capture in read_captures(path=path):
        assert isinstance(capture.repository, str) and isinstance(capture.commit, str)


def read_log(path: Path) -> None:
    log = TrainingLog(path, 2)
    write_curves(path.with_name("curves.png"), log.entries, ["loss"])


def assert_one_line(error: Exception, path: Path) -> None:
    message = str(error)
    assert path.name in message, message[:200]
    assert "\n" not in message, message[:200]


NAMES = (
    *(f"image.{kind}" for kind in IMAGES),
    *("clip.avi", "transforms.json", "own.json", MANIFEST_NAME, "model.onnx", "old.onnx", "a.ckpt", "old.pth"),
    *("a.safetensors", "0.torch", "index.json", "captures.json", "rows.json", "last.ckpt", "log.jsonl", "000.npz"),
)


@tried(30)
@given(data=st.data())
@pytest.mark.parametrize("name", NAMES)
def test_any_content_is_read_or_refused(
    name: str, targets: dict[str, Target], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: st.DataObject
) -> None:
    monkeypatch.setenv("IDESPLAT_MAX_MEGAPIXELS", "1")
    target = targets[name]
    contents = mutated(target.content)
    if target.document is not None:
        contents |= mutated_json(target.document)
    path = tmp_path / name
    path.write_bytes(data.draw(contents))
    if name == "000.npz":
        shutil.copy(path, tmp_path / "001.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # commands do not show them; see test_processes.py
        try:
            target.read(path)
        except (InputError, CheckpointError) as error:
            assert_one_line(error, path)


@pytest.mark.parametrize("name", NAMES)
def test_the_good_files_are_read(name: str, targets: dict[str, Target], tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(targets[name].content)
    if name == "000.npz":
        (tmp_path / "001.npz").write_bytes(targets[name].content)
    targets[name].read(tmp_path / name)


@tried(100)
@given(data=st.data())
def test_any_metadata_of_a_graph(targets: dict[str, Target], tmp_path: Path, data: st.DataObject) -> None:
    model = onnx.load_from_string(targets["model.onnx"].content)
    (entry,) = (entry for entry in model.metadata_props if entry.key == METADATA_KEY)
    document = JSON(entry.value)
    text = data.draw(mutated_json(document) | mutated(entry.value.encode()))
    entry.value = text.decode(errors="replace")
    path = tmp_path / "model.onnx"
    path.write_bytes(model.SerializeToString())
    try:
        Predictor(path)
    except InputError as error:
        assert_one_line(error, path)


@tried(100)
@given(content=st.binary(max_size=200) | mutated(b'["a.ply", "idesplat-infer", 3, 5]\n["b.ply", "x", 1, 2]\n'))
def test_any_record_of_written_files(content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "out").mkdir(exist_ok=True)
    (tmp_path / "out" / "a.ply").write_text("x")
    add_to_record(tmp_path / "out" / "a.ply", "idesplat-infer")
    (record,) = (tmp_path / "cache" / "idesplat" / "written").glob("*.jsonl")
    record.write_bytes(content)
    for name, entry in read_record(tmp_path / "out").items():
        assert isinstance(name, str) and isinstance(entry.size, int) and isinstance(entry.changed_ns, int)


PARSERS: dict[str, Callable[[str], Any]] = {
    "--size": parse_size,
    "--offset": parse_offset,
    "--focal": lambda text: parse_focal(text, 640, 480),
    "--views": parse_view_counts,
}


@tried(150)
@given(text=st.text(max_size=12) | st.sampled_from(TEXTS) | st.text("0123456789.,-+xeE:_ \u0663\u00b2", max_size=8))
@pytest.mark.parametrize("option", PARSERS)
def test_any_text_of_an_option(option: str, text: str) -> None:
    try:
        value = PARSERS[option](text)
    except InputError as error:
        assert str(error).startswith(option)
    else:
        assert value is None or np.isfinite(np.asarray(value, float)).all()
