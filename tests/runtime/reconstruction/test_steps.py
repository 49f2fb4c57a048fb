"""The steps after the prediction, on planes that cameras beside each other see."""

from types import SimpleNamespace

import numpy as np
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.undistortion import UndistortedImage
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.steps import make_plan, refine_prediction
from idesplat.runtime.splats.filtering import FilterOptions
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.points import unproject
from idesplat.runtime.views.batch import ViewBatch

SIDE, PLANE = 24, 4.0
K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1]], np.float64)
FLOATER = (0.5, 0.0, 0.8)  # right before a camera between the first two views, outside their images


def plane_before(positions: tuple[float, ...]) -> tuple[Prediction, ViewBatch]:
    """Views at positions on the x axis before a grey plane, and the plane's Gaussians, with a floater as the last."""
    count = len(positions)
    extrinsics = np.tile(np.eye(4), (count, 1, 1))
    extrinsics[:, 0, 3] = positions
    intrinsics = np.tile((K / SIDE * [[1], [1], [SIDE]]).astype(np.float32), (count, 1, 1))
    images = np.full((count, 3, SIDE, SIDE), 0.5, np.float32)
    names = [f"{view}.png" for view in range(count)]
    cameras = [Camera(name, SIDE, SIDE, K, pose) for name, pose in zip(names, extrinsics, strict=True)]
    copies = [
        UndistortedImage(np.full((SIDE, SIDE, 3), 128, np.uint8), camera, np.ones((SIDE, SIDE), bool))
        for camera in cameras
    ]
    depth = np.full((count, SIDE, SIDE), PLANE, np.float32)
    means = np.concatenate([unproject(depth, extrinsics, intrinsics).reshape(-1, 3), [FLOATER]]).astype(np.float32)
    gaussians = Gaussians(
        means,
        np.full((len(means), 3), 0.1, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (len(means), 1)),
        np.full(len(means), 0.9, np.float32),
        np.zeros((len(means), 1, 3), np.float32),
    )
    return Prediction(depth, gaussians), ViewBatch(names, images, extrinsics, intrinsics, cameras, copies=copies)


def refined(quality: str, *positions: float) -> Gaussians:
    prediction, views = plane_before(positions)
    model = SimpleNamespace(path=bundled_model(), metadata=SimpleNamespace(gaussians=True))
    plan = make_plan(quality, model, "3", FilterOptions(), 0)
    return refine_prediction(prediction, views, plan, None).prediction.need_gaussians()


def has_floater(gaussians: Gaussians) -> bool:
    return bool((gaussians.means[:, 2] < PLANE / 2).any())


def test_no_gaussian_hangs_right_before_the_cameras_after_refinement() -> None:
    made = refined("standard", 0.0, 1.0, 2.0)
    assert not has_floater(made) and len(made) > SIDE * SIDE


def test_a_prediction_that_is_not_fused_and_two_views_keep_what_they_have() -> None:
    assert has_floater(refined("fast", 0.0, 1.0, 2.0))
    assert has_floater(refined("standard", 0.0, 1.0))
