"""Views of another state of the scene are named and left out, although the points on what did not move fit."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.errors import InputError
from idesplat.runtime.views import contradictions
from idesplat.runtime.views.batch import build_view_batch
from idesplat.runtime.views.contradictions import MIN_SPREAD, Contradiction, find_contradictions
from idesplat.runtime.views.pair_fit import Verdict, fit_pair

HEIGHT, WIDTH, FOCAL = 360, 480, 400
OBJECT, BACKGROUND = 2.0, 4.0  # depths of two planes that face the cameras
BASELINE = 0.2
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float64)
PLAIN = np.full((2 * HEIGHT, 3 * WIDTH, 3), 150, np.uint8)


def make_texture(seed: int, height: int, width: int) -> np.ndarray:
    """Blobs of many sizes, where SIFT finds features, uint8 [height, width, 3]."""
    rng = np.random.default_rng(seed)
    sizes = (2, 4, 8, 16)
    noise = [cv2.GaussianBlur(rng.normal(size=(height, width, 3)), None, size) * size for size in sizes]
    return np.clip(128 + 60 * sum(noise), 0, 255).astype(np.uint8)


THING = make_texture(1, 110, 140)  # nearly a tenth of the image
BEHIND = {"before": make_texture(2, 2 * HEIGHT, 3 * WIDTH), "after": make_texture(3, 2 * HEIGHT, 3 * WIDTH)}


def make_view(number: int, background: np.ndarray):
    """A photograph of the object before a background, from a camera that moves to the right, and that camera."""
    position = BASELINE * number
    image = shifted(background, HEIGHT / 2, WIDTH + FOCAL * position / BACKGROUND)
    place = -(HEIGHT / 2 - 50), FOCAL * position / OBJECT - WIDTH * 0.85  # of the image in the object's texture
    covered = shifted(np.full(THING.shape, 255, np.uint8), *place) > 127
    extrinsics = np.eye(4)
    extrinsics[0, 3] = position
    return np.where(covered, shifted(THING, *place), image), Camera(f"{number:03d}.png", WIDTH, HEIGHT, K, extrinsics)


def shifted(image: np.ndarray, top: float, left: float) -> np.ndarray:
    """The part [HEIGHT, WIDTH] of an image from a place on, black outside it."""
    return cv2.warpAffine(image, np.array([[1, 0, -left], [0, 1, -top]], np.float64), (WIDTH, HEIGHT))


def make_views(states):
    return [make_view(number, BEHIND[state]) for number, state in enumerate(states)]


def build(pairs, automatic=True, cameras=True):
    return build_view_batch(pairs, None, 128, 160, skip_damaged=automatic, check_images=True, check_cameras=cameras)


@pytest.mark.parametrize(
    "states",
    [
        ["before"] * 4 + ["after"] * 2,
        ["after"] * 2 + ["before"] * 4,
        ["before"] * 5 + ["after"],
        ["before"] * 3 + ["after"] * 3,  # of two as large ones, the first
    ],
)
def test_views_of_the_smaller_state_are_left_out(states):
    pairs = make_views(states)
    views = build(pairs)
    names = [camera.name for _, camera in pairs]
    assert views.names == [name for name, state in zip(names, states, strict=True) if state == "before"]
    lines = dict(line.split(": ", 1) for line in views.skipped)
    assert sorted(lines) == sorted(set(names) - set(views.names))
    assert any("part of the scene was moved between them" in line for line in lines.values())
    assert all(line.startswith("contradicts 0") or "which contradicts 0" in line for line in lines.values())


@pytest.mark.parametrize("cameras", [True, False])  # estimated cameras fit their images, and follow the object
def test_the_smaller_state_is_found_where_features_have_no_other_use(cameras):
    pairs = make_views(["before"] * 4 + ["after"] * 2)
    pairs = [(image, replace(camera, depth_range=(1.0, 8.0))) for image, camera in pairs]
    views = build(pairs, cameras=cameras)
    assert len(views.names) == 4 and views.feature_images == ()


def test_such_views_are_refused_where_they_were_asked_for():
    with pytest.raises(InputError, match=r"^00\d\.png: .*contradicts 00\d\.png.*; leave it out or correct it$"):
        build(make_views(["before"] * 4 + ["after"] * 2), automatic=False)


def test_points_on_the_object_fit_across_both_states():
    """So that the cameras alone do not show what is wrong."""
    loaded = build_view_batch(make_views(["before", "after"]), None, 128, 160).feature_images
    assert fit_pair(*loaded).verdict is Verdict.FITS


def test_views_of_one_state_are_all_used():
    assert len(build(make_views(["before"] * 6)).names) == 6


def test_an_object_before_a_plain_background_is_no_contradiction(monkeypatch):
    """Nothing but the object can be matched, in any pair."""
    monkeypatch.setitem(BEHIND, "before", PLAIN)
    monkeypatch.setitem(BEHIND, "after", PLAIN // 2)
    assert len(build(make_views(["before"] * 4 + ["after"] * 2)).names) == 6


def test_points_on_one_line_tell_nothing(monkeypatch):
    """They are spread over no area."""
    for state, background in BEHIND.items():
        line = np.zeros_like(background)
        line[HEIGHT + 8 : HEIGHT + 20] = background[HEIGHT + 8 : HEIGHT + 20]  # within a row of cells
        monkeypatch.setitem(BEHIND, state, line)
    monkeypatch.setitem(globals(), "THING", np.zeros_like(THING))
    assert len(build(make_views(["before"] * 5)).names) == 5


def test_where_no_views_are_linked_none_is_of_another_state_than_most(monkeypatch):
    loaded = build_view_batch(make_views(["before"] * 3), None, 128, 160).feature_images
    parallax = {(0, 1): 3.0, (1, 2): 3.0}
    monkeypatch.setattr(contradictions, "_spread", lambda *_: MIN_SPREAD / 2)
    assert find_contradictions(loaded, parallax) == {}
    monkeypatch.setattr(contradictions, "_spread", lambda *views: MIN_SPREAD * (0.5 if 2 in views[2:] else 1))
    assert find_contradictions(loaded, parallax) == {2: Contradiction(2, 1, MIN_SPREAD / 2)}
