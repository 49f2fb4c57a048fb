"""Images and cameras brought together: each image is read once, damaged ones are left out, cameras name images."""

import json
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.inputs import Request, read_inputs
from idesplat.runtime.sfm import estimate
from idesplat.runtime.views import loader as view_loader
from idesplat.runtime.views import matching, sources
from idesplat.runtime.views.depth_range import estimate_depth_range
from idesplat.tools.synthetic.make_scene import make_scene
from PIL import ImageFile

VIEWS = 8


class SmallModel:
    """What `read_inputs` asks of a model."""

    metadata = SimpleNamespace(fixed_views=None, fixed_size=False, height=64, width=96, size_multiple=32)

    def size_for(self, cameras):
        return 64, 96

    def check_size(self, views, height, width):
        pass

    def view_count(self, asked, named, default):
        return asked or (None if named else default)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Eight images of a synthetic room, with transforms.json, which gives no size."""
    folder = tmp_path_factory.mktemp("room")
    make_scene(folder, seed=2, views=VIEWS, height=96, width=128)
    document = json.loads((folder / "transforms.json").read_text())
    for settings in (document, *document["frames"]):
        settings.pop("w", None)
        settings.pop("h", None)
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> tuple[Path, str]:
    """Three images of a size at which cameras can be estimated, and their focal length."""
    folder = tmp_path_factory.mktemp("large")
    make_scene(folder, seed=2, views=3, height=360, width=480)
    return folder, str(read_cameras(folder / "transforms.json")[0].K[0, 0])


@pytest.fixture
def capture(room, tmp_path) -> Path:
    shutil.copytree(room / "images", tmp_path / "images")
    shutil.copy(room / "transforms.json", tmp_path)
    return tmp_path


def request(folder: Path, *images: Path, cameras: str | None = None, **changes) -> Request:
    options = {"camera_format": None, "focal": None, "select": None, "views": None, "size": None, **changes}
    return Request(list(images), cameras or str(folder / "transforms.json"), **options)


def read(folder: Path, *images: Path, **changes):
    return read_inputs(request(folder, *(images or [folder / "images"]), **changes), SmallModel())


@pytest.fixture
def counted(monkeypatch) -> Counter:
    """How often images are decoded, and features are looked for."""
    counter: Counter = Counter()

    def counting(name, function):
        def counts(*args, **kwargs):
            counter[name] += 1
            return function(*args, **kwargs)

        return counts

    monkeypatch.setattr(cv2, "imdecode", counting("decoded", cv2.imdecode))
    monkeypatch.setattr(ImageFile.ImageFile, "load", counting("decoded", ImageFile.ImageFile.load))
    for module in (view_loader, matching, estimate):
        monkeypatch.setattr(module, "extract_features", counting("sift", module.extract_features))
    return counter


def ranged(inputs):
    views = inputs.views
    arrays = views.images, views.extrinsics, views.intrinsics
    return estimate_depth_range(*arrays, views.cameras, (1.0, 100.0), matcher=views.matcher)


def test_an_image_is_decoded_once_and_only_if_it_is_used(capture, counted):
    inputs = read(capture, views=2)
    assert len(inputs.views.names) == 2
    assert "points matched" in ranged(inputs).source
    # Three images are sampled, each with its best partner and the next one; two of these, or others, are chosen.
    assert counted["decoded"] <= VIEWS and counted["sift"] <= counted["decoded"]
    counted.clear()
    inputs = read(capture, select="0,3,5")
    assert counted == {"decoded": 3, "sift": 3}  # to check that the images fit their cameras
    ranged(inputs)
    assert counted == {"decoded": 3, "sift": 3}


def test_estimating_cameras_decodes_once(large, counted):
    folder, focal = large
    inputs = read(folder, cameras="estimate", focal=focal, select="0,2")
    ranged(inputs)
    assert counted == {"decoded": 2, "sift": 2}


def test_damaged_images_are_named_and_left_out(capture):
    names = read(capture, views=2).views.names
    for name in names:
        content = (capture / "images" / name).read_bytes()
        (capture / "images" / name).write_bytes(content[: len(content) // 2])
    cameras = json.loads((capture / "transforms.json").read_text())
    (capture / "transforms.json").write_text(json.dumps({"w": 128, "h": 96, **cameras}))
    inputs = read(capture, views=2)
    assert len(inputs.views.names) == 2 and not set(names) & set(inputs.views.names)
    damaged = [note for note in inputs.notes if "is damaged" in note]
    assert damaged and all(note.endswith("left out") for note in damaged)
    assert {Path(note.partition(":")[0]).name for note in damaged} <= set(names)
    with pytest.raises(InputError, match=f"{names[0]}: is damaged"):  # it was asked for
        read(capture, select=",".join(names))


def test_notes_name_images_that_are_left_out_and_warn_of_those_that_were_asked_for(capture):
    first, second = read(capture, views=2).views.names
    paths = [capture / "images" / name for name in (first, second)]
    cv2.imwrite(str(paths[0]), cv2.imread(str(paths[0])) // 64)
    inputs = read(capture, views=VIEWS)
    assert len(inputs.views.names) == VIEWS - 1 and first not in inputs.views.names
    (line,) = [note for note in inputs.notes if note.startswith(first)]
    assert "shows nothing" in line and line.endswith("; left out")
    cv2.imwrite(str(paths[1]), cv2.GaussianBlur(cv2.imread(str(paths[1])), None, 4))
    others = [path.name for path in sorted((capture / "images").iterdir()) if path.name != first]
    inputs = read(capture, select=",".join(others))
    assert inputs.views.names == others
    assert any(note.startswith(f"warning: {second}: is blurred") for note in inputs.notes)
    with pytest.raises(InputError, match=f"{first}: shows nothing.*; leave it out"):
        read(capture, select=f"{first},{second}")


def test_too_few_undamaged_images(capture):
    for path in sorted((capture / "images").iterdir())[1:]:
        path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"1 image with a camera, expected at least 2, 7 cannot be used \(.*damaged"):
        read(capture, views=2)


def test_estimating_leaves_out_damaged_images_and_copies(large, tmp_path):
    pytest.importorskip("pycolmap")
    folder, focal = large
    images = tmp_path / "images"
    shutil.copytree(folder / "images", images)
    first, second, last = sorted(images.iterdir())
    second.write_bytes(second.read_bytes()[:100])
    shutil.copy(first, images / "copy.png")
    skipped: list[str] = []
    with pytest.raises(InputError, match=r"1 image that can be used \(.*is damaged"):
        estimate.estimate_cameras([first, second], focal, skipped)
    with pytest.raises(InputError, match=r"1 image that can be used \(.*copy\.png: is the same image as .*000"):
        estimate.estimate_cameras([first, images / "copy.png"], focal, skipped)
    with pytest.raises(InputError, match="is damaged"):
        estimate.estimate_cameras([first, second, last], focal)
    cameras = estimate.estimate_cameras([first, second, images / "copy.png", last], focal, skipped)
    assert [camera.name for camera in cameras] == [str(first), str(last)]
    assert [line.partition(":")[0] for line in skipped] == [str(second), str(images / "copy.png")]


def test_unread_formats_are_said(capture):
    for name in ("IMG_1.dng", "IMG_2.gif"):
        (capture / "images" / name).write_bytes(b"")
    notes = read(capture, views=2).notes
    assert "2 images are of an unsupported format, and left out: IMG_1.dng, IMG_2.gif; save as JPEG or PNG" in notes


# ---- images that cameras name


def named(cameras: Path, folder: Path) -> list[Path]:
    return sources.find_input_images([], cameras, None, folder)


def test_cameras_name_their_images(capture):
    inputs = read_inputs(request(capture), SmallModel())
    assert inputs.views.names == read(capture).views.names
    next((capture / "images").glob("*3.png")).unlink()
    assert len(named(capture / "transforms.json", capture)) == VIEWS - 1
    assert len(named(capture, capture)) == VIEWS - 1
    assert "1 of 8 cameras have no image" in read_inputs(request(capture), SmallModel()).notes[0]


def test_images_beside_the_file_and_names_without_suffix(capture):
    document = json.loads((capture / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["file_path"] = Path(frame["file_path"]).stem
    (capture / "transforms.json").write_text(json.dumps({"w": 128, "h": 96, **document}))
    found = named(capture / "transforms.json", capture)
    assert [path.parent.name for path in found] == ["images"] * VIEWS
    shutil.rmtree(capture / "images")
    with pytest.raises(InputError, match=r"transforms\.json: none of the 8 images that it names .* give --images"):
        named(capture / "transforms.json", capture)
    with pytest.raises(InputError, match="--images is missing"):
        sources.find_input_images([], None, None, capture)


def test_colmap_models_find_their_images(capture):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=128, height=96, params=[100, 100, 64, 48], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for index, path in enumerate(sorted((capture / "images").iterdir())):
        image = pycolmap.Image(name=path.name, camera_id=1, image_id=index + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([float(index), 0, 0]))
        model.add_image_with_trivial_frame(image, pose)
    (capture / "sparse" / "0").mkdir(parents=True)
    model.write(capture / "sparse" / "0")
    (capture / "transforms.json").unlink()
    for given in (capture, capture / "sparse", capture / "sparse" / "0", capture / "sparse" / "0" / "images.bin"):
        assert len(named(given, capture)) == VIEWS
