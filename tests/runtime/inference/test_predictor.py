"""The predictor as a library."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from idesplat import InputError, Predictor, read_cameras
from idesplat.export.example_inputs import example_inputs
from idesplat.runtime.images.io import load_image
from idesplat.runtime.inference.metadata import INPUTS
from idesplat.runtime.views.batch import build_view_batch

ROOT = Path(__file__).parent.parent.parent.parent


@pytest.fixture(scope="module")
def predictor(exported):
    return Predictor(exported[0])


@pytest.fixture
def arrays():
    inputs = example_inputs(2, 64, 64, 0.5, 100.0)
    return {name: inputs[name].numpy().copy() for name in INPUTS[:3]}


def test_predict_takes_images_and_cameras(predictor, scene):
    cameras = read_cameras(scene / "transforms.json")[:2]
    from_files = predictor.predict([scene / camera.name for camera in cameras], cameras)
    from_arrays = predictor.predict([load_image(scene / camera.name) for camera in cameras], cameras)
    assert from_files.depth.shape == (2, 64, 96)
    assert len(from_files.gaussians) == 2 * 64 * 96
    np.testing.assert_array_equal(from_files.depth, from_arrays.depth)


def test_floating_point_images_are_not_darkened(predictor, scene):
    """The same image, as bytes and as floating point in [0, 1]."""
    cameras = read_cameras(scene / "transforms.json")[:2]
    images = [load_image(scene / camera.name) for camera in cameras]
    expected = predictor.predict(images, cameras)
    for dtype in (np.float32, np.float64):
        found = predictor.predict([image.astype(dtype) / 255 for image in images], cameras)
        np.testing.assert_array_equal(found.depth, expected.depth)
        np.testing.assert_array_equal(found.gaussians.sh, expected.gaussians.sh)


@pytest.mark.parametrize(
    "change",
    (
        lambda image: image.astype(np.float32),  # 0 to 255
        lambda image: image.astype(np.float32) / 127.5 - 1,
        lambda image: image.astype(np.uint16),
        lambda image: image.astype(np.int64),
        lambda image: image > 127,
        lambda image: image[..., 0],
        lambda image: image.transpose(2, 0, 1),
        lambda image: np.dstack([image, image[..., :1]]),
        lambda image: np.where(image > 200, np.nan, image / 255),
        lambda image: image[:0],
    ),
)
def test_images_that_may_mean_anything_are_refused(predictor, scene, change):
    cameras = read_cameras(scene / "transforms.json")[:2]
    images = [load_image(scene / camera.name) for camera in cameras]
    with pytest.raises(InputError, match=r"001\.png: an image of .*expected RGB .* uint8 in 0 to 255 or as floating"):
        predictor.predict([images[0], change(images[1])], cameras)


def test_without_near_and_far_the_unit_does_not_matter(predictor, scene):
    """A scene in millimetres: the model's own range, 0.5 to 100, would end before the nearest wall."""
    cameras = read_cameras(scene / "transforms.json")[:2]
    views = build_view_batch([(scene / camera.name, camera) for camera in cameras], None, 64, 96)
    arrays = views.images, views.extrinsics, views.intrinsics
    expected = predictor.predict_arrays(*arrays)
    millimetres = views.extrinsics.copy()
    millimetres[:, :3, 3] *= 1000
    found = predictor.predict_arrays(views.images, millimetres, views.intrinsics)
    assert (np.abs(found.depth / 1000 - expected.depth) < 1e-3 * expected.depth).mean() > 0.99
    spans = [prediction.cameras[0].depth_range for prediction in (expected, found)]
    np.testing.assert_allclose(np.array(spans[1]) / 1000, spans[0], rtol=1e-3)
    given = predictor.predict_arrays(views.images, millimetres, views.intrinsics, near=np.array([900.0, 1000.0]))
    assert given.cameras[1].depth_range == (1000, pytest.approx(spans[1][1]))


def test_without_points_in_common_the_baseline_tells_near_and_far(predictor, arrays):
    arrays["images"][:] = 0.5
    arrays["extrinsics"][:, :3, 3] *= 1000
    baseline = np.linalg.norm(np.subtract(*arrays["extrinsics"][:, :3, 3]))
    assert predictor.predict_arrays(**arrays).cameras[0].depth_range == pytest.approx((baseline, 200 * baseline))


def test_predictions_carry_the_cameras_of_their_depth(predictor, scene):
    """At the network's size, so that they lead from depth to points."""
    cameras = read_cameras(scene / "transforms.json")[:2]
    own = predictor.predict([scene / camera.name for camera in cameras], cameras, 1, 20, (64, 64)).cameras
    for camera, original in zip(own, cameras, strict=True):
        assert camera.name == Path(original.name).name
        assert (camera.width, camera.height, camera.depth_range) == (64, 64, (1, 20))
        assert camera.distortion is None
        np.testing.assert_array_equal(camera.extrinsics, original.extrinsics)
        # 128 x 96 becomes 85 x 64, of which 10 columns are cut off at the left
        matrix = np.array([[85 / 128, 0, -10], [0, 64 / 96, 0], [0, 0, 1]])
        np.testing.assert_allclose(camera.K, matrix @ original.K, rtol=1e-5)


def test_near_and_far_bound_the_depth(predictor, arrays):
    depth = predictor.predict_arrays(**arrays, near=2, far=5).depth
    assert depth.min() >= 2 * (1 - 1e-5)
    assert depth.max() <= 5 * (1 + 1e-5)


@pytest.mark.parametrize(("unit", "position"), ((1e3, (0, 0, 0)), (1e-3, (0, 0, 0)), (1.0, (4e5, 5e6, 300))))
def test_a_scene_in_any_unit_and_place_gives_the_same(predictor, arrays, unit, position):
    """In millimetres, or where a surveyor's coordinates have it: the result is the same, in the user's own world."""
    expected = predictor.predict_arrays(**arrays, near=0.8, far=40)
    poses = arrays["extrinsics"].astype(np.float64)
    poses[:, :3, 3] = poses[:, :3, 3] * unit + position
    moved = predictor.predict_arrays(arrays["images"], poses, arrays["intrinsics"], near=0.8 * unit, far=40 * unit)
    # Rounding may move a projection across a pixel's edge, where nearest-neighbour warping picks another feature.
    close = np.abs(moved.depth / unit - expected.depth) < 1e-4 * expected.depth
    assert close.mean() > 0.999
    means = (moved.gaussians.means - np.array(position)) / unit
    rounding = 2e-4 + 4 * np.finfo(np.float32).eps * np.abs(position).max()
    assert (np.abs(means - expected.gaussians.means).max(axis=1) < rounding * expected.depth.max()).mean() > 0.999
    scales = np.abs(moved.gaussians.scales / unit - expected.gaussians.scales) < 1e-3 * expected.gaussians.scales
    assert scales.mean() > 0.995
    np.testing.assert_allclose(moved.gaussians.quats, expected.gaussians.quats, atol=1e-2)


def corrupt(name, index, value):
    def change(arrays):
        arrays[name][index] = value

    return change


BAD_ARRAYS = {
    "NaN in the images": (corrupt("images", (0, 0, 0, 0), np.nan), "images"),
    "NaN in a pose": (corrupt("extrinsics", (1, 0, 3), np.nan), "extrinsics"),
    "NaN in the intrinsics": (corrupt("intrinsics", (0, 0, 0), np.nan), "intrinsics"),
    "zero focal length": (corrupt("intrinsics", (0, 0, 0), 0), "intrinsics"),
    "mirrored pose": (corrupt("extrinsics", (1, slice(None), 0), [-1, 0, 0, 0]), "extrinsics"),
    "pixels of 255": (corrupt("images", 0, 255), "0 to 1"),
    "one view": (lambda arrays: arrays.update({k: v[:1] for k, v in arrays.items()}), "at least 2"),
    "same camera twice": (lambda arrays: arrays["extrinsics"].__setitem__(1, arrays["extrinsics"][0]), "same"),
    "counts that differ": (lambda arrays: arrays.update(extrinsics=arrays["extrinsics"][:1]), "extrinsics"),
    "a size it cannot take": (lambda arrays: arrays.update(images=arrays["images"][..., :50]), "multiples of 16"),
}


@pytest.mark.parametrize("name", BAD_ARRAYS)
def test_bad_arrays_are_refused(predictor, arrays, name):
    change, expected = BAD_ARRAYS[name]
    change(arrays)
    with pytest.raises(InputError, match=expected) as error:
        predictor.predict_arrays(**arrays)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("near", "far"), ((5, 2), (2, 2), (0, 2), (-1, 2), (np.nan, 2)))
def test_near_must_be_before_far(predictor, arrays, near, far):
    with pytest.raises(InputError, match="near"):
        predictor.predict_arrays(**arrays, near=near, far=far)


def test_models_that_are_not_ours_are_refused(tmp_path, exported):
    other = onnx.load(exported[0])
    del other.metadata_props[:]
    onnx.save(other, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"other\.onnx: not a model of this project"):
        Predictor(tmp_path / "other.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(InputError, match=r"text\.onnx: no ONNX model, or damaged"):
        Predictor(tmp_path / "text.onnx")
    with pytest.raises(InputError, match="no such model"):
        Predictor(tmp_path / "none.onnx")
    with pytest.raises(InputError, match=r"no manifest\.json"):
        Predictor(tmp_path)


@pytest.mark.parametrize(
    "content",
    ("", "[]", "{}", '{"stages": [{}]}', '{"stages": [{"name": "a", "file": "../x", "inputs": [], "outputs": []}]}'),
)
def test_damaged_manifests_are_refused(tmp_path, content):
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json"):
        Predictor(tmp_path)


# ---- rules between the packages


def test_running_a_model_never_loads_torch(exported, scene, tmp_path):
    code = (
        "import sys; from idesplat.runtime.cli.infer import main; main(); "
        "assert not {'torch', 'onnx'} & set(sys.modules), 'loaded'"
    )
    arguments = ["--images", scene / "images", "--cameras", scene / "transforms.json", "--model", exported[0]]
    command = [sys.executable, "-c", code, *map(str, [*arguments, "--out", tmp_path / "scene.ply"])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "scene.ply").is_file()


def test_runner_is_a_deprecated_name_of_predictor():
    from idesplat import runtime

    with pytest.warns(DeprecationWarning, match="Predictor"):
        assert runtime.Runner is Predictor
