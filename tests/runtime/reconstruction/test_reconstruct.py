"""`reconstruct` and `Reconstruction`: the flow of `idesplat infer` as a library, which prints nothing."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from idesplat import InputError, Reconstruction, read_cameras, read_splats, reconstruct
from idesplat.runtime.images.io import load_image
from idesplat.runtime.reconstruction import pipeline
from idesplat.runtime.splats.filtering import FilterOptions
from scene_files import snapshot
from tiny_model import write_model

NAMES = ("000.png", "001.png")


@pytest.fixture
def place(scene, tmp_path, monkeypatch) -> Path:
    """A folder with a model, in which we stand."""
    monkeypatch.chdir(tmp_path)
    write_model(Path("model.onnx"))
    return tmp_path


def run(scene: Path, **options) -> Reconstruction:
    settings = {"model": "model.onnx", "size": (32, 48), "near": 1.0, "far": 10.0, **options}
    return reconstruct(settings.pop("images", scene / "images"), settings.pop("cameras", None), **settings)


def test_files_and_arrays_give_the_same_and_nothing_is_printed(place, scene, capfd):
    steps: list[str] = []
    before = snapshot(place)
    by_files = run(scene, select="0,1", progress=lambda report: steps.append(report.description))
    assert "finding near and far" in steps
    files = [scene / "images" / name for name in NAMES]
    cameras = {Path(camera.name).name: camera for camera in read_cameras(scene / "transforms.json")}
    given = [cameras[name] for name in NAMES]
    by_arrays = run(scene, images=[load_image(file) for file in files], cameras=given)
    by_cameras = run(scene, images=files, cameras=given)
    for other in (by_arrays, by_cameras):
        assert np.array_equal(other.depth, by_files.depth)
        assert np.array_equal(other.gaussians.means, by_files.gaussians.means)
    assert capfd.readouterr() == ("", "")
    assert snapshot(place) == before


def test_what_a_reconstruction_holds_and_saves(place, scene):
    made = run(scene, filters=FilterOptions(crop_border=2))
    assert len(made.cameras) == len(made.views.names) == 2
    assert made.depth.shape == (2, 32, 48) and made.metadata.preset
    assert made.removed == {"crop_border": 2 * (32 * 48 - 28 * 44)} and len(made.gaussians) == 2 * 28 * 44
    assert {"load", "prepare"} <= set(made.timings)
    assert "cameras found beside the photographs" in made.notes[0]
    assert made.save("out.ply") == []
    assert len(read_splats(Path("out.ply"))) == len(made.gaussians)
    made.save("out.mesh.ply")
    made.save_cameras("c.json")
    assert len(read_cameras(Path("c.json"))) == 5
    depth, renders = made.save_depth("depth"), made.save_renders("renders")
    assert len(depth) == 4 and len(renders) == 26 and all(path.is_file() for path in (*depth, *renders))
    made.save_report("report.html")
    assert "2 " in Path("report.html").read_text()
    assert made.summary()["filtered"]["left_out"] == made.removed


def test_exposures_are_compensated_unless_it_is_switched_off(place, scene):
    cameras = {Path(camera.name).name: camera for camera in read_cameras(scene / "transforms.json")}
    images = [load_image(scene / "images" / name) for name in NAMES]

    def made(images, **options) -> Reconstruction:
        return run(scene, images=images, cameras=[cameras[name] for name in NAMES], **options)

    same, plain = made(images), made(images, exposure="off")
    assert np.array_equal(same.views.images, plain.views.images) and np.array_equal(same.depth, plain.depth)
    assert not any("exposure" in line for line in same.notes)
    assert same.summary()["exposure"]["compensated"] is plain.summary()["exposure"]["compensated"] is False
    assert plain.summary()["exposure"]["difference"] is None

    darker = [images[0], (0.8 * images[1]).astype(np.uint8)]
    found, left = made(darker), made(darker, exposure="off")
    summary = found.summary()["exposure"]
    assert summary["difference"] == pytest.approx(0.25, abs=0.04) and summary["compensated"]
    assert np.divide(*summary["gains"]) == pytest.approx(np.full(3, 0.8), abs=0.03)
    assert len([line for line in found.notes if "exposure differs by" in line]) == 1
    assert np.array_equal(found.views.images, found.exposure.apply(left.views.images))
    assert not np.array_equal(found.views.images, left.views.images) and left.exposure.is_identity


def test_inputs_are_checked_before_the_model_is_loaded(place, scene, monkeypatch):
    monkeypatch.setattr(pipeline.Predictor, "__init__", lambda *given: pytest.fail("loaded"))

    def fail(inputs) -> None:
        raise InputError(f"not {len(inputs.cameras)}")

    with pytest.raises(InputError, match="not 5"):
        run(scene, on_inputs=fail)
    with pytest.raises(InputError, match="expected near < far"):
        run(scene, near=3.0, far=2.0)
    with pytest.raises(InputError, match="exposure on: expected one of auto, off"):
        run(scene, exposure="on")
    with pytest.raises(InputError, match="no such"):
        run(scene, model="missing.onnx")
    with pytest.raises(InputError, match="a Camera for each"):
        run(scene, images=[np.zeros((32, 48, 3), np.uint8)] * 2)


def test_the_flow_is_one_short_function():
    assert len(inspect.getsource(reconstruct).partition('"""\n')[2].splitlines()) < 80
