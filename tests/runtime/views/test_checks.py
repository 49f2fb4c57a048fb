"""Images that would spoil a reconstruction are named, and left out or refused; good ones are not."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.cameras.undistortion import shrink
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.io import load_image
from idesplat.runtime.views.batch import build_view_batch
from idesplat.runtime.views.image_quality import measure
from idesplat.runtime.views.loader import FeatureImage
from idesplat.runtime.views.pair_fit import Verdict, fit_pair
from idesplat.tools.synthetic.make_scene import make_scene
from shared_fixtures import build_once

SIZE = 128, 160
VIEWS = 6
# A folder of photographs with transforms.json, checked beside the synthetic ones, which are always.
PHOTOGRAPHS = os.environ.get("IDESPLAT_PHOTOGRAPHS")


def read_pairs(folder, side=640):
    """Images with their cameras, named by the file alone."""
    pairs = []
    for camera in read_cameras(folder / "transforms.json"):
        image, camera = shrink(load_image(folder / camera.name), camera, side)
        pairs.append((image, replace(camera, name=Path(camera.name).name)))
    return pairs


def make_rooms(factory):
    def make(folder):
        for name, seed in (("room", 2), ("other", 5)):
            make_scene(folder / name, seed=seed, views=VIEWS, height=240, width=320)

    return build_once(factory, "rooms", make)


@pytest.fixture(scope="module", params=["synthetic", "photographs"])
def scenes(request, tmp_path_factory):
    """Images of a scene with their cameras, and an image of another scene."""
    rooms = make_rooms(tmp_path_factory)
    if request.param == "synthetic":
        return read_pairs(rooms / "room"), read_pairs(rooms / "other")[0][0]
    if PHOTOGRAPHS is None:
        pytest.skip("IDESPLAT_PHOTOGRAPHS names no folder of photographs with transforms.json")
    return read_pairs(Path(PHOTOGRAPHS)), read_pairs(rooms / "room")[0][0]


@pytest.fixture
def pairs(scenes):
    return list(scenes[0])


def build(pairs, count=None, automatic=True):
    return build_view_batch(pairs, count, *SIZE, skip_damaged=automatic, check_images=True, check_cameras=True)


def chosen_of(pairs):
    """The indices of the two views that are chosen while all images are good."""
    names = build_view_batch(pairs, 2, *SIZE).names
    return [index for index, (_, camera) in enumerate(pairs) if camera.name in names]


def other_scene(pairs, index, other):
    height, width = pairs[index][0].shape[:2]
    return cv2.resize(other, (width, height), interpolation=cv2.INTER_AREA)


BAD = {
    "shows nothing": lambda pairs, index, other: pairs[index][0] // 64,
    "is overexposed": lambda pairs, index, other: np.clip(5.0 * pairs[index][0], 0, 255).astype(np.uint8),
    "is blurred": lambda pairs, index, other: cv2.GaussianBlur(pairs[index][0], None, 6),
    "shows another scene than its camera": other_scene,
}


def spoil(pairs, index, image):
    return [*pairs[:index], (image, pairs[index][1]), *pairs[index + 1 :]]


@pytest.mark.slow
def test_good_images_are_used_as_before(pairs):
    for count in (None, 2, 4):
        views, expected = build(pairs, count), build_view_batch(pairs, count, *SIZE)
        assert views.names == expected.names and not views.skipped and not views.warnings
        np.testing.assert_array_equal(views.images, expected.images)
    assert build(pairs, automatic=False).names == [camera.name for _, camera in pairs]


@pytest.mark.parametrize("known_depth", [False, True])
@pytest.mark.parametrize("what", BAD)
def test_a_bad_image_is_left_out_and_the_next_takes_its_place(pairs, scenes, what, known_depth):
    if known_depth:  # features are then looked for in smaller copies
        pairs = [(image, replace(camera, depth_range=(0.5, 50.0))) for image, camera in pairs]
    index = chosen_of(pairs)[0]
    spoiled = spoil(pairs, index, BAD[what](pairs, index, scenes[1]))
    views = build(spoiled, 2)
    (line,) = views.skipped
    name = pairs[index][1].name
    assert line.startswith(f"{name}: {what}") and any(character.isdigit() for character in line.partition(":")[2])
    assert len(views.names) == 2 and name not in views.names
    everything = build(spoiled)
    assert everything.names == [camera.name for _, camera in pairs if camera.name != name]
    assert (views.feature_images == ()) == known_depth


@pytest.mark.parametrize("what", BAD)
def test_a_bad_image_that_was_asked_for_is_refused_unless_it_is_only_blurred(pairs, scenes, what):
    index = chosen_of(pairs)[0]
    name = pairs[index][1].name
    spoiled = spoil(pairs, index, BAD[what](pairs, index, scenes[1]))
    if what == "is blurred":
        views = build(spoiled, automatic=False)
        assert len(views.names) == len(pairs) and not views.skipped
        (line,) = views.warnings
        assert line.startswith(f"{name}: is blurred")
    else:
        with pytest.raises(InputError, match=f"^{name}: {what}.*; leave it out"):
            build(spoiled, automatic=False)


@pytest.mark.parametrize("automatic", [True, False])
@pytest.mark.parametrize("what", BAD)
def test_fewer_than_two_good_images_are_refused_unless_one_is_only_blurred(pairs, scenes, what, automatic):
    index, partner = chosen_of(pairs)
    spoiled = spoil(pairs, index, BAD[what](pairs, index, scenes[1]))
    two = [spoiled[index], spoiled[partner]]
    name = pairs[index][1].name
    if what == "is blurred":
        views = build(two, automatic=automatic)
        assert len(views.names) == 2 and views.warnings[0].startswith(f"{name}: is blurred")
        return
    with pytest.raises(InputError) as raised:
        build(two, automatic=automatic)
    assert name in str(raised.value) and "\n" not in str(raised.value)
    assert (what in str(raised.value)) != (what == "shows another scene than its camera")  # it may as well be the other


@pytest.mark.slow
def test_an_image_with_the_pose_of_another_is_left_out(pairs):
    index, partner = chosen_of(pairs)
    far = 0 if index > len(pairs) // 2 else len(pairs) - 1
    turned = pairs[far][1].extrinsics.copy()  # a wrong rotation, too: along the baseline no epipolar line shows it
    turned[:3, :3] = turned[:3, :3] @ cv2.Rodrigues(np.array([0.1, 0.0, 0.1]))[0]
    turned[:3, 3] += 0.5 * (pairs[partner][1].extrinsics[:3, 3] - pairs[far][1].extrinsics[:3, 3])
    wrong = [*pairs[:index], (pairs[index][0], replace(pairs[index][1], extrinsics=turned)), *pairs[index + 1 :]]
    views = build(wrong)
    name = pairs[index][1].name
    assert name not in views.names and len(views.names) == len(pairs) - 1
    assert views.skipped[0].startswith(f"{name}: does not fit its camera: ")
    assert "pixels from their epipolar lines" in views.skipped[0]
    with pytest.raises(InputError, match=f"^{name}: does not fit its camera"):
        build(wrong, automatic=False)


def test_cameras_that_fit_no_image_are_refused(pairs):
    """Here each camera is rolled by more than the one before."""
    wrong = []
    for image, camera in pairs:
        extrinsics = camera.extrinsics.copy()
        extrinsics[:3, :3] = extrinsics[:3, :3] @ cv2.Rodrigues(np.array([0.0, 0.0, 0.3 * len(wrong)]))[0]
        wrong.append((image, replace(camera, extrinsics=extrinsics)))
    with pytest.raises(InputError, match=r"do not fit their cameras: .*; check that the cameras are those of these"):
        build(wrong, 2)


def test_the_same_image_twice_is_used_once(pairs):
    index = chosen_of(pairs)[0]
    first = index - 1 if index else len(pairs) - 1
    views = build(spoil(pairs, index, pairs[first][0]))
    assert len(views.names) == len(pairs) - 1 and len(views.skipped) == 1
    assert {pairs[index][1].name, pairs[first][1].name} - set(views.names)  # the one whose camera is wrong, if it shows


@pytest.mark.slow
def test_a_camera_given_twice_is_used_once(pairs):
    index, partner = chosen_of(pairs)
    camera = replace(pairs[index][1], name="copy.png")
    views = build([*pairs, (pairs[index][0], camera)])
    assert views.skipped == [f"copy.png: is the same image as {pairs[index][1].name}, expected another"]
    views = build([*pairs, (pairs[index][0] // 2, camera)])
    assert views.skipped == [f"copy.png: has the same pose as {pairs[index][1].name}, expected another"]
    wrong = build([*pairs, (pairs[partner][0] // 2, camera)])  # of both, the one that does not fit is left out
    assert wrong.names == [camera.name for _, camera in pairs]
    with pytest.raises(InputError, match=r"copy\.png: is the same image as"):
        build([*pairs, (pairs[index][0], camera)], automatic=False)


def test_images_are_checked_only_when_asked_for(pairs):
    index = chosen_of(pairs)[0]
    spoiled = spoil(pairs, index, pairs[index][0] // 64)
    assert len(build_view_batch(spoiled, None, *SIZE, skip_damaged=True).names) == len(pairs)


# ---- measures


def test_the_blur_effect_ignores_contrast_and_finds_blur_along_one_axis(pairs):
    image = pairs[0][0].transpose(2, 0, 1).astype(np.float32) / 255
    sharp, faint = measure(image), measure(0.4 + 0.2 * image)
    assert faint.detail < 0.1 * sharp.detail and faint.blur == pytest.approx(sharp.blur, abs=0.05)
    for axes in ((9, 1), (1, 9)):
        moved = cv2.blur(np.ascontiguousarray(image.transpose(1, 2, 0)), axes).transpose(2, 0, 1)
        assert measure(moved).blur > sharp.blur + 0.1


def test_exchanged_cameras_contradict_although_their_epipolar_lines_are_right(pairs):
    """By a pure translation both Sampson distances are equal, but the points lie behind the cameras."""
    index, partner = chosen_of(pairs)
    images = [FeatureImage(*pairs[number]) for number in (index, partner)]
    assert fit_pair(*images).verdict is Verdict.FITS
    first, second = (pairs[number][1].extrinsics for number in (index, partner))
    mirrored = second.copy()
    mirrored[:3, 3] = 2 * first[:3, 3] - second[:3, 3]  # on the other side of the first
    wrong = FeatureImage(pairs[partner][0], replace(pairs[partner][1], extrinsics=mirrored))
    assert fit_pair(images[0], wrong).verdict is Verdict.CONTRADICTS


def test_pairs_without_a_baseline_are_not_judged(pairs):
    (image, camera), (other, _) = pairs[:2]
    assert fit_pair(FeatureImage(image, camera), FeatureImage(other, camera)).verdict is Verdict.UNKNOWN


def test_an_image_saved_again_is_identical(pairs):
    image, camera = pairs[0]
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
    again = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1]
    saved = FeatureImage(np.ascontiguousarray(again), pairs[1][1])
    assert fit_pair(FeatureImage(image, camera), saved).verdict is Verdict.IDENTICAL
