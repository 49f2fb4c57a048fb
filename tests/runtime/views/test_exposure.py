"""Exposure between views: known gains and offsets are found on a plane whose colours and matches are exact."""

from dataclasses import replace

import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.views import loader, matching
from idesplat.runtime.views.batch import build_view_batch
from idesplat.runtime.views.exposure import MAX_GAIN, Exposure, compensate_exposure, solve_exposure
from idesplat.runtime.views.exposure_mode import ExposureMode, parse_exposure_mode
from idesplat.runtime.views.matching import PointMatches
from views_in_a_row import extrinsics_in_a_row

SIDE = 128  # pixels
POINTS = 300  # of a pair of views
K = np.array([[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]])  # normalised
STEP = 0.2  # between cameras, which look at a plane at depth 1
AUTO, OFF = ExposureMode.AUTO, ExposureMode.OFF


def plane_colours(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The colours of points of the plane, smooth against the blur, [..., 3] in 0.2 to 0.8."""
    waves = (np.sin(3 * x + 1), np.cos(2.5 * y), np.sin(2 * x - 2 * y))
    mixed = np.stack([waves[0] + 0.5 * waves[1], waves[1] + 0.5 * waves[2], waves[2] + 0.5 * waves[0]], axis=-1)
    return 0.5 + 0.2 * mixed


class Plane:
    """Views of a plane, with exact matches at random points: what `solve_exposure` asks of a `ViewMatcher`.

    gains, offsets: of the camera, [views, 3]. wrong: share of matches with another point. blind: views without matches.
    """

    def __init__(self, gains, offsets=0.0, wrong=0.0, blind=(), points=POINTS):
        self.gains = np.broadcast_to(np.asarray(gains, float), (len(gains), 3))
        self.offsets = np.broadcast_to(np.asarray(offsets, float), (len(gains), 3))
        self.wrong, self.blind, self.points = wrong, blind, points
        self.rng = np.random.default_rng(0)
        self.extrinsics = extrinsics_in_a_row(*(STEP * np.arange(len(gains))))
        self.intrinsics = np.tile(K, (len(gains), 1, 1))
        centres = (np.arange(SIDE) + 0.5) / SIDE
        u, v = np.meshgrid((centres - K[0, 2]) / K[0, 0], (centres - K[1, 2]) / K[1, 1])
        seen = [plane_colours(u + pose[0, 3], v) for pose in self.extrinsics]
        exposed = np.stack(seen) * self.gains[:, None, None] + self.offsets[:, None, None]
        self.images = self.quantized(exposed).transpose(0, 3, 1, 2)  # [views, 3, height, width]

    def quantized(self, images):
        """8-bit values of images with a sensor's noise."""
        noisy = images + self.rng.normal(0, 0.01, images.shape)
        return np.round(255 * np.clip(noisy, 0, 1)).astype(np.float32) / np.float32(255)

    def match(self, i, j, max_features=None):
        count = 0 if i in self.blind or j in self.blind else self.points
        x = self.rng.uniform(STEP * j - 0.95, STEP * i + 0.95, count)  # what both see
        y = self.rng.uniform(-0.95, 0.95, count)
        first, second = np.stack([x - STEP * i, y], axis=1), np.stack([x - STEP * j, y], axis=1)
        moved = self.rng.random(count) < self.wrong
        second[moved] = self.rng.uniform(-0.95, 0.95, (moved.sum(), 2))
        return PointMatches(first, second, np.eye(4))


def spread(plane, found, views=slice(None)):
    """The largest difference between views, of the corrected colours of points of dark and of bright colour."""
    colours = np.array([0.25, 0.5, 0.75])[:, None, None]
    corrected = found.gains * (plane.gains * colours + plane.offsets) + found.offsets  # [colours, views, 3]
    return np.ptp(corrected[:, views], axis=1).max()


TWO = [[1.06, 1.0, 0.9], [0.94, 1.0, 1.1]]
SIX = [[1.1, 1.05, 1.0], [1.0, 1.0, 1.0], [0.8, 0.85, 0.9], [0.9, 0.9, 0.9], [1.0, 0.95, 0.9], [1.2, 1.15, 1.1]]


@pytest.mark.parametrize("gains", [TWO, SIX])
@pytest.mark.parametrize("offset", [0.0, 0.03])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_known_gains_and_offsets_are_found(gains, offset, wrong):
    offsets = offset * np.cos(np.arange(len(gains)))[:, None]
    plane = Plane(gains, offsets, wrong)
    unchanged = solve_exposure(Plane(np.ones((len(gains), 3))).images, plane)
    before, found = spread(plane, unchanged), solve_exposure(plane.images, plane)
    # Noise of 0.01, averaged over the blur and hundreds of points, and the prior leave less than a hundredth.
    assert unchanged.is_identity and before > 0.08
    assert spread(plane, found) < 0.01
    # The overall brightness stays.
    assert np.log(found.gains).mean(axis=0) == pytest.approx(0, abs=0.01)
    assert found.offsets.mean(axis=0) == pytest.approx(0, abs=0.01)
    middle = np.array(gains) * 0.5 + offsets
    assert found.difference == pytest.approx((middle.max(axis=0) / middle.min(axis=0)).max() - 1, abs=0.02)
    corrected = found.apply(plane.images)
    assert corrected.dtype == np.float32 and 0 <= corrected.min() <= corrected.max() <= 1
    assert corrected.mean() == pytest.approx(plane.images.mean(), abs=0.03)


@pytest.mark.parametrize("views", [2, 6])
@pytest.mark.parametrize("points", [10, POINTS])
def test_images_of_constant_exposure_stay_bit_identical(views, points):
    plane = Plane(np.ones((views, 3)), wrong=0.3, points=points)
    found = solve_exposure(plane.images, plane)
    assert found.is_identity and found.notes == []
    assert found.difference is not None and found.difference < 0.05
    assert found.apply(plane.images) is plane.images


def test_a_small_difference_is_told_and_left():
    plane = Plane([[1.01] * 3, [0.98] * 3])
    found = solve_exposure(plane.images, plane)
    assert found.is_identity
    assert found.difference == pytest.approx(0.03, abs=0.01)
    assert found.summary()["compensated"] is False


def test_views_without_matches_stay_as_they_are():
    plane = Plane(SIX, blind=(2,))
    found = solve_exposure(plane.images, plane)
    assert (found.gains[2] == 1).all() and (found.offsets[2] == 0).all()
    assert spread(plane, found, [0, 1, 3, 4, 5]) < 0.01
    assert np.array_equal(found.apply(plane.images)[2], plane.images[2])
    nothing = solve_exposure(plane.images, Plane(SIX, blind=range(6)))
    assert nothing.is_identity and nothing.difference is None


def test_few_matches_and_those_of_one_place_are_not_trusted():
    plane = Plane([[1.3] * 3, [0.7] * 3], points=5)
    assert solve_exposure(plane.images, plane).difference is None
    first = plane.rng.uniform([0, 0], [0.45, 0.45], (POINTS, 2))
    plane.match = lambda *_: PointMatches(first, first - [STEP, 0], np.eye(4))
    assert solve_exposure(plane.images, plane).difference is None


def test_a_textured_object_does_not_outvote_its_surroundings():
    """An object with most of the features looks darker from one side, as a can does; the floor does not."""
    plane = Plane(np.ones((2, 3)))
    plane.images[0, :, :32, 48:80] *= 0.8
    u, v = np.meshgrid(np.linspace(-0.9, 0.9, 12), np.linspace(-0.4, 0.9, 12))
    floor = np.stack([u.ravel(), v.ravel()], axis=1)
    rest = plane.rng.uniform([-0.2, -0.9], [0.2, -0.6], (400, 2))
    first = np.concatenate([floor, rest])
    plane.match = lambda *_: PointMatches(first, first - [STEP, 0], np.eye(4))
    assert solve_exposure(plane.images, plane).is_identity


def test_chance_is_no_exposure():
    """Surfaces that each view sees in another light, at few points: any fit differs, and hardly one holds elsewhere."""
    found = []
    for seed in range(20):
        plane = Plane(np.ones((2, 3)), points=16)
        plane.rng = np.random.default_rng(seed)
        lights = plane.rng.uniform(0.7, 1.4, (8, 8)).repeat(SIDE // 8, axis=0).repeat(SIDE // 8, axis=1)
        plane.images[0] = np.clip(lights * plane.images[0], 0, 1)
        found.append(solve_exposure(plane.images, plane))
    assert sum(each.difference > 0.05 for each in found) >= 10
    assert sum(not each.is_identity for each in found) <= 1


def test_clipped_pixels_do_not_count():
    """In the brighter view the brightest sixth is white, so that its colours are lost."""
    plane = Plane([[1.45] * 3, [0.9] * 3])
    assert (plane.images[0] == 1).mean() > 1 / 6
    found = solve_exposure(plane.images, plane)
    assert found.gains[1] / found.gains[0] == pytest.approx(1.45 / 0.9, rel=0.03)


def test_gains_are_limited():
    plane = Plane([[1.2] * 3, [0.1] * 3])
    found = solve_exposure(plane.images, plane)
    assert found.gains == pytest.approx(np.array([[1 / MAX_GAIN] * 3, [MAX_GAIN] * 3]))


@pytest.fixture(scope="module")
def room(scene):
    """Four views of a synthetic room, with features."""
    pairs = [(scene / camera.name, camera) for camera in read_cameras(scene / "transforms.json")[:4]]
    return build_view_batch(pairs, None, 96, 128)


def test_a_room_with_features(room):
    same, found = compensate_exposure(room, AUTO)
    assert same is room and found.is_identity and found.difference < 0.05
    gains = np.array([1.05, 0.85, 0.95, 0.9], np.float32)[:, None, None, None]
    darker = replace(room, images=gains * room.images)
    views, found = compensate_exposure(darker, AUTO)
    exposure = (found.gains * gains[:, :, 0, 0]).mean(axis=1)
    assert exposure / exposure.mean() == pytest.approx(1, abs=0.02)
    assert np.array_equal(views.images, found.apply(darker.images))
    assert "exposure differs by 2" in found.notes[0] and "compensated" in found.notes[0]
    unchanged, none = compensate_exposure(darker, OFF)
    assert unchanged is darker and none.is_identity and none.difference is None


def test_features_are_not_needed_in_advance(room):
    """Views whose cameras have a depth range have no feature images; features are then those of the small images."""
    gains = np.array([1.1, 0.9, 1.1, 0.9], np.float32)[:, None, None, None]
    plain = replace(room, images=np.clip(gains * room.images, 0, 1), feature_images=())
    _, found = compensate_exposure(plain, AUTO)
    assert found.difference == pytest.approx(1.1 / 0.9 - 1, abs=0.03)
    assert not found.is_identity


def test_pairs_are_matched_once(room, monkeypatch):
    matched = []
    match_features = matching.match_features
    for module in (loader, matching):
        monkeypatch.setattr(module, "match_features", lambda *given: matched.append(1) or match_features(*given))
    matcher = replace(room).matcher
    first = matcher.match(0, 1)
    once = len(matched)
    assert once <= 1  # the images keep their matches, too
    assert matcher.match(0, 1) is first and matcher.match(0, 1, 10) is first
    assert len(matched) == once
    assert 0 < len(matcher.match(0, 2, 40).first) <= 40 < len(matcher.match(0, 2).first)


def test_modes_are_named():
    assert parse_exposure_mode("off") is OFF
    with pytest.raises(InputError, match="exposure on: expected one of auto, off"):
        parse_exposure_mode("on")


def test_two_corrections_in_a_row_are_one_and_can_be_undone() -> None:
    rng = np.random.default_rng(0)
    first, second = (Exposure(rng.uniform(0.5, 2, (2, 3)), rng.uniform(-0.2, 0.2, (2, 3))) for _ in range(2))
    image = rng.uniform(0.3, 0.7, (4, 5, 3))
    once = first.gains[1] * image + first.offsets[1]
    twice = second.gains[1] * once + second.offsets[1]
    np.testing.assert_allclose(first.then(second).undo(twice, 1), image)
