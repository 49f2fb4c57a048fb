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


def test_exif_tells_the_focal_length(room, tmp_path):
    paths, known = room
    width, height = known[0].width, known[0].height
    film = round(known[0].K[0, 0] * np.hypot(36, 24) / np.hypot(width, height))
    tagged = []
    for path in (paths[0], paths[2]):
        image = Image.open(path)
        exif = image.getexif()
        exif.get_ifd(0x8769)[FOCAL_LENGTH_35MM] = film
        tagged.append(tmp_path / f"{path.stem}.jpg")
        image.save(tagged[-1], exif=exif, quality=98)
    assert exif_focal(tagged[0], width, height) == pytest.approx(known[0].K[0, 0], rel=0.02)  # whole millimetres
    assert exif_focal(paths[0], width, height) is None
    rotation, direction = relative_errors(estimate_cameras(tagged), [known[0], known[2]])
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


@pytest.mark.parametrize("depths", [[], [np.nan, np.nan], [-1.0, -2.0]])
def test_a_reconstruction_without_points_in_front_of_the_cameras(monkeypatch, depths):
    """The median depth is the unit, so it must be one; COLMAP is replaced by what it would return."""
    model = SimpleNamespace(images={1: SimpleNamespace(has_pose=True, name="000000")}, num_reg_images=lambda: 1)
    monkeypatch.setitem(sys.modules, "pycolmap", MagicMock(incremental_mapping=lambda *_: {0: model}))
    replaced = {"_fill": None, "reversed_relief": None, "describe": [], "observed_depths": np.array(depths)}
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
