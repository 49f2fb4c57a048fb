"""Cameras from images alone, compared with the known cameras of a synthetic room."""

import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.exif import exif_focal, parse_focal
from idesplat.runtime.images.io import load_image
from idesplat.runtime.sfm import incremental
from idesplat.runtime.sfm.estimate import estimate_cameras
from idesplat.runtime.sfm.incremental import Start
from idesplat.tools.synthetic.make_scene import make_scene
from PIL import Image

FOCAL_LENGTH_35MM = 0xA405  # EXIF 2.32


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Images of a synthetic room, and their true cameras."""
    folder = tmp_path_factory.mktemp("room")
    make_scene(folder, seed=2, views=3, height=360, width=480)
    cameras = read_cameras(folder / "transforms.json")
    return [folder / camera.name for camera in cameras], cameras


def relative_errors(found, known, first=0, second=1):
    """Degrees between the relative rotations, and between the directions of translation."""
    ours, theirs = (np.linalg.inv(cameras[second].extrinsics) @ cameras[first].extrinsics for cameras in (found, known))
    turn = np.linalg.norm(cv2.Rodrigues(ours[:3, :3].T @ theirs[:3, :3])[0])
    a, b = ours[:3, 3], theirs[:3, 3]
    return np.degrees(turn), np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))


def test_two_images(room):
    paths, known = room
    found = estimate_cameras([paths[0], paths[2]], str(known[0].K[0, 0]))
    rotation, direction = relative_errors(found, [known[0], known[2]])
    assert rotation < 0.5 and direction < 3
    assert [camera.name for camera in found] == [str(paths[0]), str(paths[2])]
    np.testing.assert_array_equal(found[0].extrinsics, np.eye(4))
    np.testing.assert_allclose(found[0].K, known[0].K, atol=1e-9)
    # The unit is the median depth: the true one, in the true unit, tells the scale.
    depth = np.load(paths[0].parent.parent / "depth" / f"{paths[0].stem}.npz")["depth"]
    baseline = np.linalg.norm(known[2].extrinsics[:3, 3] - known[0].extrinsics[:3, 3])
    scale = np.linalg.norm(found[1].extrinsics[:3, 3]) / baseline
    assert 0.6 < np.median(depth) * scale < 1.6
    near, far = found[0].depth_range
    assert near < np.percentile(depth, 2) * scale and far > np.percentile(depth, 98) * scale


@pytest.mark.slow
def test_three_images_through_the_mapper(room):
    paths, known = room
    for focal in (str(known[0].K[0, 0]), None):
        found = estimate_cameras(paths, focal)
        assert [camera.name for camera in found] == [str(path) for path in paths]
        np.testing.assert_allclose(found[0].extrinsics, np.eye(4), atol=1e-12)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            rotation, direction = relative_errors(found, known, i, j)
            assert rotation < 2 and direction < 5
        # The lengths of the steps are known up to one factor.
        steps = [
            np.linalg.norm(cameras[1].extrinsics[:3, 3] - cameras[0].extrinsics[:3, 3])
            / np.linalg.norm(cameras[2].extrinsics[:3, 3] - cameras[1].extrinsics[:3, 3])
            for cameras in (found, known)
        ]
        assert steps[0] == pytest.approx(steps[1], rel=0.1)
        assert all(camera.depth_range is not None for camera in found)


@pytest.mark.slow
def test_the_mapper_goes_on_from_a_reconstruction_whose_relief_was_reversed(room, monkeypatch):
    paths, known = room

    def without_the_last(model, _):
        """A part of the reconstruction, as `reversed_relief` gives it."""
        model.deregister_frame(max(model.images.values(), key=lambda image: image.name).frame_id)
        return model

    monkeypatch.setattr(incremental, "reversed_relief", without_the_last)
    found = estimate_cameras(paths, str(known[0].K[0, 0]))
    assert [camera.name for camera in found] == [str(path) for path in paths]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        rotation, direction = relative_errors(found, known, i, j)
        assert rotation < 2 and direction < 5


@pytest.fixture(scope="module")
def tagged(room, tmp_path_factory):
    """The room's images with the focal length in their EXIF data, in whole millimetres."""
    paths, known = room
    folder = tmp_path_factory.mktemp("tagged")
    film = round(known[0].K[0, 0] * np.hypot(36, 24) / np.hypot(known[0].width, known[0].height))
    written = []
    for path in paths:
        image = Image.open(path)
        exif = image.getexif()
        exif.get_ifd(0x8769)[FOCAL_LENGTH_35MM] = film
        written.append(folder / f"{path.stem}.jpg")
        image.save(written[-1], exif=exif, quality=98)
    return written


def test_exif_tells_the_focal_length(room, tagged):
    paths, known = room
    width, height = known[0].width, known[0].height
    assert exif_focal(tagged[0], width, height) == pytest.approx(known[0].K[0, 0], rel=0.02)  # whole millimetres
    assert exif_focal(paths[0], width, height) is None
    rotation, direction = relative_errors(estimate_cameras([tagged[0], tagged[2]]), [known[0], known[2]])
    assert rotation < 2 and direction < 5


def test_given_focal_lengths():
    assert parse_focal("1375.5", 1080, 1920) == 1375.5
    assert parse_focal("36mm", 3600, 2400) == pytest.approx(3600)  # 36 mm is as wide as the film
    for text in ("", "mm", "-5", "0", "0mm", "26 cm", "1e3", "nan"):
        with pytest.raises(InputError, match="expected pixels"):
            parse_focal(text, 100, 100)


def save(path, rgb):
    cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))
    return path


@pytest.mark.slow
def test_refusals(room, tmp_path, monkeypatch):
    (first, second, _), (camera, *_) = room
    focal = str(camera.K[0, 0])
    image = load_image(first)
    turned = camera.K @ cv2.Rodrigues(np.array([0.0, 0.06, 0.01]))[0] @ np.linalg.inv(camera.K)
    rotated = save(tmp_path / "turned.png", cv2.warpPerspective(image, turned, image.shape[1::-1]))
    blank = save(tmp_path / "blank.png", np.full_like(image, 128))
    noise = save(tmp_path / "noise.png", np.random.default_rng(0).integers(0, 255, image.shape, np.uint8))
    for paths, given, expected in (
        ([first], focal, "1 image given, expected two at least"),
        ([first, second], None, "has no focal length; give --focal"),
        ([first, second], "wide", "--focal wide: expected pixels"),
        ([first, second], "999999", r"000\.png: the focal lengths .* not plausible"),
        ([first, first], focal, r"nearly the same place: .*expected 1\.5 at least; step aside"),
        ([first, rotated], focal, "nearly the same place"),
        ([first, blank], focal, "0 features match, expected 40 at least"),
        ([first, noise], focal, "(features match|matches are inliers of a static scene), expected"),
        ([first, blank, noise], focal, "none of the 3 images could be registered"),
    ):
        with pytest.raises(InputError, match=expected) as caught:
            estimate_cameras(paths, given)
        assert "\n" not in str(caught.value)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"3 images need pycolmap \(pip install .*--select"):
        estimate_cameras([first, second, blank], focal)


@pytest.mark.slow
def test_a_start_that_is_held_is_the_focal_length_in_each_run(room, monkeypatch):
    paths, known = room
    start = Start(held=True, focal=1.1 * known[0].K[0, 0] / known[0].width)
    monkeypatch.setattr(incremental, "UNKNOWN_STARTS", [start])
    found, again = estimate_cameras(paths), estimate_cameras(paths)
    assert [camera.name for camera in found] == [str(path) for path in paths]
    assert found[0].K[0, 0] == pytest.approx(start.focal * known[0].width, rel=1e-9)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.extrinsics, other.extrinsics)


@pytest.mark.slow
@pytest.mark.parametrize(("most", "held"), [(3, True), (2, False)])
def test_the_mapper_holds_known_focal_lengths_of_few_images(room, tagged, monkeypatch, most, held):
    monkeypatch.setattr(incremental, "MAX_HELD", most)
    film = exif_focal(tagged[0], *reversed(load_image(tagged[0]).shape[:2]))
    assert (estimate_cameras(tagged)[0].K[0, 0] == pytest.approx(film, rel=1e-6)) == held


@pytest.mark.parametrize(
    ("images", "refine_focal", "held"),
    [(incremental.MAX_HELD, True, [True, False]), (incremental.MAX_HELD + 1, True, [False, True]), (3, False, [True])],
)
def test_known_focal_lengths_are_held_and_refined(images, refine_focal, held):
    starts = incremental._starts([SimpleNamespace(focal=500.0)] * images, refine_focal)
    assert [start.held for start in starts] == held


def model(registered, points, focal):
    """As much of a reconstruction as is needed to compare it."""
    image = SimpleNamespace(has_pose=True, name="0", camera_id=1, num_points3D=points)
    camera = SimpleNamespace(focal_length=focal, width=100, height=50)
    images = dict(enumerate([image] * registered))
    return SimpleNamespace(images=images, cameras={1: camera}, num_points3D=lambda: points)


@pytest.mark.parametrize(
    ("found", "best", "tried"),
    [
        ([model(4, 100, 90)], 0, 1),
        ([None, model(3, 100, 90), model(4, 50, 90)], 2, 3),  # three of four are not more than GOOD_SHARE
        ([model(4, 100, 1000), model(2, 100, 90), None, model(2, 80, 90)], 1, 4),  # 1000 pixels are implausible
        ([None, model(4, 0, 90), None, None], 0, 4),  # without points it is none
        ([None] * 4, 0, 4),
    ],
)
def test_the_best_reconstruction_is_kept(found, best, tried, monkeypatch):
    left = list(found)
    monkeypatch.setattr(incremental, "_set_unknown_focals", lambda *_: None)
    monkeypatch.setattr(incremental, "_map_right_relief", lambda *_: left.pop(0))
    starts = incremental._starts([SimpleNamespace(focal=None)] * 4, refine_focal=True)
    assert incremental._reconstruct("database", "folder", 4, starts) is found[best]
    assert len(found) - len(left) == tried


@pytest.mark.parametrize("depths", [[], [np.nan, np.nan], [-1.0, -2.0]])
def test_a_reconstruction_without_points_in_front_of_the_cameras(monkeypatch, depths):
    """The median depth is the unit, so it must be one; COLMAP is replaced by what it would return."""
    monkeypatch.setitem(sys.modules, "pycolmap", MagicMock())
    found = model(1, 0, 90)
    replaced = {"_fill": None, "_reconstruct": found, "describe": [], "observed_depths": np.array(depths)}
    for name, value in replaced.items():
        monkeypatch.setattr(incremental, name, lambda *_, value=value: value)
    with pytest.raises(InputError, match=r"no points in front of them found, .*; give more images") as caught:
        incremental.run_incremental_sfm([], refine_focal=True)
    assert "\n" not in str(caught.value)


def test_images_as_a_phone_saves_them(room, tmp_path):
    """Noise of the sensor, another exposure in each image, and lossy compression."""
    paths, known = room
    saved = []
    for index, exposure in ((0, 0.8), (2, 1.1)):
        image = load_image(paths[index]).astype(np.float32)
        noisy = exposure * image + np.random.default_rng(index).normal(0, 5, image.shape)
        saved.append(tmp_path / f"{index}.jpg")
        rgb = np.clip(noisy, 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(saved[-1]), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    found = estimate_cameras(saved, str(known[0].K[0, 0]))
    rotation, direction = relative_errors(found, [known[0], known[2]])
    assert rotation < 2 and direction < 5
