"""Prediction in groups: every view in order, from groups that fit the memory, and the best of several predictions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction import many_views
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.batch import ViewBatch
from idesplat.runtime.views.depth_range import BASELINE, DepthRange
from views_in_a_row import extrinsics_in_a_row

HEIGHT, WIDTH = 4, 6
SPAN = DepthRange(5.0, 20.0, "given")
K = np.array([[6.0, 0, 3], [0, 6.0, 2], [0, 0, 1]])


def batch(count: int) -> ViewBatch:
    """Views along a line, in a mixed order, whose images have their number as their value."""
    numbers = np.random.default_rng(0).permutation(count)
    extrinsics = extrinsics_in_a_row(*(0.8 * numbers))
    names = [f"{number}.png" for number in numbers]
    cameras = [Camera(name, WIDTH, HEIGHT, K, pose) for name, pose in zip(names, extrinsics, strict=True)]
    images = np.ones((count, 3, HEIGHT, WIDTH), np.float32) * numbers[:, None, None, None]
    intrinsics = np.tile(np.float32([[1, 0, 0.5], [0, 1.5, 0.5], [0, 0, 1]]), (count, 1, 1))
    return ViewBatch(names, images, extrinsics, intrinsics, cameras)


class NumberingPredictor:
    """Predicts each image's number as its depth, opacity and means; keeps the groups and their depth ranges."""

    def __init__(self, gaussians: bool, trained_views: int = 5, source: str = "points") -> None:
        self.gaussians, self.source = gaussians, source
        self.groups: list[list[str]] = []
        self.ranges: list[tuple[float, float]] = []
        self.metadata = SimpleNamespace(trained_views=[2, trained_views], height=HEIGHT, width=WIDTH, fixed_size=False)
        self.model = SimpleNamespace(metadata=self.metadata)

    def depth_range(self, views: ViewBatch, near: float | None, far: float | None) -> DepthRange:
        """A range that the first image's number tells; none for a near beyond it, as the real one."""
        found = DepthRange(near or 1.0 + views.images[0, 0, 0, 0], far or 30.0, self.source)
        if found.near >= found.far:
            raise InputError("near")
        return found

    def predict_views(self, views: ViewBatch, near: float, far: float) -> Prediction:
        self.groups.append(views.names)
        self.ranges.append((near, far))
        depth = views.images[:, 0]
        flat = depth.ravel()
        gaussians = Gaussians(
            np.repeat(flat[:, None], 3, axis=1),
            np.ones((flat.size, 3), np.float32),
            np.ones((flat.size, 4), np.float32),
            flat,
            np.zeros((flat.size, 1, 3), np.float32),
        )
        return Prediction(depth, gaussians if self.gaussians else None, {"model": 1.0}, views.cameras)


@pytest.mark.parametrize("count", [2, 5, 6, 17])
@pytest.mark.parametrize("gaussians", [True, False])
def test_every_view_is_predicted_and_in_order(count: int, gaussians: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many_views, "GROUP_PIXELS", 5 * HEIGHT * WIDTH)
    views, predictor = batch(count), NumberingPredictor(gaussians)
    prediction = many_views.predict_views(predictor, views, SPAN)
    np.testing.assert_array_equal(prediction.depth, views.images[:, 0])
    assert [camera.name for camera in prediction.cameras] == views.names
    assert all(len(names) <= 5 for names in predictor.groups)
    assert (len(predictor.groups) == 1) == (count <= 5)
    assert prediction.seconds == {"model": float(len(predictor.groups))}
    if gaussians:
        np.testing.assert_array_equal(prediction.need_gaussians().opacities, views.images[:, 0].ravel())
    else:
        assert prediction.gaussians is None


def test_large_images_still_run_in_groups_of_three(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many_views, "GROUP_PIXELS", 1)
    predictor = NumberingPredictor(True)
    many_views.predict_views(predictor, batch(7), SPAN)
    assert {len(names) for names in predictor.groups} <= {2, 3}


def test_a_group_is_no_larger_than_the_network_was_trained_with() -> None:
    predictor = NumberingPredictor(True, trained_views=3)
    many_views.predict_views(predictor, batch(7), SPAN)
    assert {len(names) for names in predictor.groups} <= {2, 3}
    whole = NumberingPredictor(True, trained_views=8)
    many_views.predict_views(whole, batch(7), SPAN)
    assert [len(names) for names in whole.groups] == [7] and whole.ranges == [(SPAN.near, SPAN.far)]


def test_every_group_has_its_own_depth_range_unless_it_is_given_or_unknown() -> None:
    own, given, unknown, behind = (
        NumberingPredictor(True, 3, source) for source in ("points", "given", BASELINE, "points")
    )
    many_views.predict_views(own, batch(7), SPAN)
    assert own.ranges == [(1.0 + int(names[0].partition(".")[0]), 30.0) for names in own.groups]
    many_views.predict_views(given, batch(7), DepthRange(2.0, 9.0, "given"), near=2.0, far=9.0)
    assert set(given.ranges) == {(2.0, 9.0)}
    many_views.predict_views(unknown, batch(7), SPAN)
    many_views.predict_views(behind, batch(7), SPAN, near=40.0)
    assert set(unknown.ranges) == set(behind.ranges) == {(SPAN.near, SPAN.far)}


def test_no_group_ends_nearer_than_all_views_do() -> None:
    """Where a group's matches are all on an object, other views' tell how far away the wall behind it is."""
    predictor = NumberingPredictor(True, 3)
    many_views.predict_views(predictor, batch(7), replace(SPAN, far=80.0))
    assert {far for _, far in predictor.ranges} == {80.0}
    assert len({near for near, _ in predictor.ranges}) > 1


class FailingPredictor(NumberingPredictor):
    """Predicts a plane at a depth of 10, but for one view beside a certain other one."""

    def __init__(self, view: str, partner: str) -> None:
        super().__init__(True, trained_views=3)
        self.view, self.partner = view, partner

    def predict_views(self, views: ViewBatch, near: float, far: float) -> Prediction:
        prediction = super().predict_views(replace(views, images=np.full_like(views.images, 10.0)), near, far)
        if self.view in views.names and self.partner in views.names:
            prediction.depth[views.names.index(self.view)] = 7.0
        return prediction


def test_a_view_that_its_own_group_has_wrong_is_taken_from_another_group() -> None:
    views = batch(9)
    views.images[:] = 0.5
    plain = NumberingPredictor(True, trained_views=3)
    many_views.predict_views(plain, views, SPAN)
    own = next(names for names in plain.groups if "4.png" in names and "3.png" in names)
    assert any("4.png" in names and "3.png" not in names for names in plain.groups), own
    prediction = many_views.predict_views(FailingPredictor("4.png", "3.png"), views, SPAN)
    np.testing.assert_array_equal(prediction.depth, 10.0)


def test_a_view_that_a_third_view_spoils_is_taken_from_its_pair() -> None:
    """Of three views only what is fused is also predicted in pairs, since that takes time."""
    views = batch(3)
    views.images[:] = 0.5
    first, middle, last = (views.names.index(f"{number}.png") for number in range(3))
    predictor = FailingPredictor("0.png", "2.png")
    plain = many_views.predict_views(predictor, views, SPAN)
    assert np.all(plain.depth[first] == 7) and np.all(plain.depth[[middle, last]] == 10)
    fused = many_views.predict_views(predictor, views, SPAN, for_fusion=True)
    np.testing.assert_array_equal(fused.depth, 10.0)


@pytest.mark.parametrize(("other_views", "most"), [(18, 3), (9, 2), (8, 1)])
def test_no_more_predictions_are_kept_than_fit_the_memory(
    other_views: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = batch(9)
    views.images[:] = 0.5
    chosen_from: list[int] = []
    best = many_views.DepthRating.best

    def counting_best(rating: many_views.DepthRating, view: int, predictions: list[Prediction]) -> Prediction:
        chosen_from.append(len(predictions))
        return best(rating, view, predictions)

    monkeypatch.setattr(many_views.DepthRating, "best", counting_best)
    monkeypatch.setattr(many_views, "OTHER_PIXELS", other_views * HEIGHT * WIDTH)
    prediction = many_views.predict_views(NumberingPredictor(True, trained_views=3), views, SPAN)
    np.testing.assert_array_equal(prediction.depth, 0.5)
    assert len(chosen_from) == 9 and max(chosen_from) == most
