"""The steps after the prediction, on planes that cameras beside each other see."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from idesplat.runtime.cameras.undistortion import UndistortedImage
from idesplat.runtime.geometry.sh import SH_0
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.steps import Plan, fuse, make_plan, refine_prediction
from idesplat.runtime.splats.filtering import FilterOptions
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.batch import ViewBatch
from idesplat.runtime.views.depth_range import DepthRange
from views_in_a_row import prediction_of, views_in_a_row

SIDE, PLANE = 24, 4.0
K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1]], np.float64)
FLOATER = (0.5, 0.0, 0.8)  # right before a camera between the first two views, outside their images


def plane_before(positions: tuple[float, ...]) -> tuple[Prediction, ViewBatch]:
    """Views at positions on the x axis before a grey plane, and the plane's Gaussians, with a floater as the last."""
    count = len(positions)
    views = views_in_a_row(np.full((count, 3, SIDE, SIDE), 0.5, np.float32), positions, K)
    grey, seen = np.full((SIDE, SIDE, 3), 128, np.uint8), np.ones((SIDE, SIDE), bool)
    copies = [UndistortedImage(grey, camera, seen) for camera in views.cameras]
    prediction = prediction_of(np.full((count, SIDE, SIDE), PLANE), views, scale=0.1)
    plane = prediction.need_gaussians()
    floater = replace(plane.select(np.array([0])), means=np.float32([FLOATER]))
    return replace(prediction, gaussians=Gaussians.concatenate([plane, floater])), replace(views, copies=copies)


def plan_of(quality: str, steps: int) -> Plan:
    model = SimpleNamespace(path=bundled_model(), metadata=SimpleNamespace(gaussians=True))
    return make_plan(quality, model, str(steps), FilterOptions(), 0)


def refined(quality: str, *positions: float) -> Gaussians:
    prediction, views = plane_before(positions)
    return refine_prediction(prediction, views, plan_of(quality, 3), None).prediction.need_gaussians()


def has_floater(gaussians: Gaussians) -> bool:
    return bool((gaussians.means[:, 2] < PLANE / 2).any())


def test_no_gaussian_hangs_right_before_the_cameras_after_refinement() -> None:
    made = refined("standard", 0.0, 1.0, 2.0)
    assert not has_floater(made) and len(made) > SIDE * SIDE


def test_a_prediction_that_is_not_fused_and_two_views_keep_what_they_have() -> None:
    assert has_floater(refined("fast", 0.0, 1.0, 2.0))
    assert has_floater(refined("standard", 0.0, 1.0))


def test_the_exposure_of_a_darker_photograph_is_told() -> None:
    prediction, views = plane_before((0.0, 1.0))
    darker = replace(views.copies[1], image=(0.8 * views.copies[1].image).astype(np.uint8))
    views = replace(views, copies=[views.copies[0], darker])
    found = refine_prediction(prediction, views, plan_of("standard", 20), None).exposure
    grey = np.full((1, 1, 3), 0.5)
    assert (found.undo(grey, 1) < found.undo(grey, 0)).all()


def fused(quality: str, steps: int) -> Gaussians:
    """Black Gaussians of grey views."""
    prediction, views = plane_before((0.0, 1.0))
    black = replace(prediction.need_gaussians(), sh=np.full_like(prediction.need_gaussians().sh, -0.5 / SH_0))
    black = black.select(np.arange(2 * SIDE * SIDE))
    plan = plan_of(quality, steps)
    return fuse(
        replace(prediction, gaussians=black), views, DepthRange(1, 10, "given"), plan
    ).prediction.need_gaussians()


def test_colours_are_fitted_where_no_refinement_does_it() -> None:
    assert np.median(fused("standard", 0).colours) > 0.4
    for quality, steps in (("standard", 3), ("fast", 0)):
        np.testing.assert_allclose(fused(quality, steps).colours, 0, atol=1e-6)
