"""Images that are too large for the network: it predicts them smaller, and the result is enlarged."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from idesplat.runtime.geometry.sh import SH_0
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.enlarging import network_size, predict_enlarged
from idesplat.runtime.reconstruction.many_views import predict_views
from idesplat.runtime.splats.points import pixel_rays, unproject
from idesplat.runtime.views.batch import ViewBatch
from idesplat.runtime.views.depth_range import DepthRange
from views_in_a_row import prediction_of, views_in_a_row

TRAINED = 64  # pixels a side
HEIGHT, WIDTH = 192, 256
K = np.array([[200.0, 0, WIDTH / 2], [0, 200.0, HEIGHT / 2], [0, 0, 1]])
# A slanted plane in the camera's frame: NORMAL . point = 1.
NORMAL = np.array([0.1, -0.05, 0.25])


def model(fixed_size: bool = False) -> Any:
    return SimpleNamespace(
        metadata=SimpleNamespace(
            height=TRAINED, width=TRAINED, size_multiple=16, fixed_size=fixed_size, trained_views=[2, 3]
        )
    )


def large_views(count: int = 2) -> ViewBatch:
    images = np.random.default_rng(0).random((count, 3, HEIGHT, WIDTH)).astype(np.float32)
    return views_in_a_row(images, 0.5 * np.arange(count), K)


class PlanePredictor:
    """Predicts the exact depth of the plane in every view's frame, and Gaussians in the colours of its images."""

    def __init__(self, gaussians: bool = True) -> None:
        self.model, self.gaussians = model(), gaussians
        self.metadata = self.model.metadata
        self.sizes: list[tuple[int, ...]] = []

    def depth_range(self, views: ViewBatch, near: float | None, far: float | None) -> DepthRange:
        return DepthRange(near or 1.0, far or 30.0, "given")

    def predict_views(self, views: ViewBatch, near: float, far: float) -> Prediction:
        self.sizes.append(views.images.shape[2:])
        done = prediction_of(plane_depth(views), views)
        gaussians = done.need_gaussians()
        gaussians.sh[:, 0] = (views.images.transpose(0, 2, 3, 1).reshape(-1, 3) - 0.5) / SH_0
        cameras = [
            replace(camera, width=views.images.shape[3], height=views.images.shape[2], K=at_size(views))
            for camera in views.cameras
        ]
        return replace(done, gaussians=gaussians if self.gaussians else None, seconds={"model": 1.0}, cameras=cameras)


def at_size(views: ViewBatch) -> np.ndarray:
    height, width = views.images.shape[2:]
    return views.intrinsics[0] * [[width], [height], [1]]


def plane_depth(views: ViewBatch) -> np.ndarray:
    return (1 / (pixel_rays(views.intrinsics, *views.images.shape[2:]) @ NORMAL)).astype(np.float32)


@pytest.mark.parametrize("size", [(64, 64), (80, 128), (96, 96)])
def test_images_of_somewhat_more_than_the_trained_area_stay_as_they_are(size: tuple[int, int]) -> None:
    assert network_size(model(), *size) == size


@pytest.mark.parametrize("size", [(192, 256), (256, 192), (1024, 1024), (128, 512)])
def test_larger_images_keep_their_shape_at_about_twice_the_trained_area(size: tuple[int, int]) -> None:
    height, width = network_size(model(), *size)
    assert height % 16 == width % 16 == 0
    assert 2 * TRAINED**2 <= height * width < 1.5 * 2 * TRAINED**2
    assert abs(np.log(height / width * size[1] / size[0])) < 0.15


def test_a_model_of_one_size_keeps_it() -> None:
    assert network_size(model(fixed_size=True), 512, 512) == (512, 512)


def test_a_slanted_plane_stays_one_and_colours_are_those_of_the_whole_images() -> None:
    predictor, views = PlanePredictor(), large_views()
    done = predict_enlarged(predictor, views, 1.0, 30.0)
    assert predictor.sizes == [network_size(model(), HEIGHT, WIDTH)] != [(HEIGHT, WIDTH)]
    inner = (slice(None), slice(4, -4), slice(4, -4))  # beyond the outermost centres, depth is constant
    np.testing.assert_allclose(done.depth[inner], plane_depth(views)[inner], rtol=1e-5)
    gaussians = done.need_gaussians()
    means = unproject(done.depth, views.extrinsics, views.intrinsics).reshape(-1, 3)
    np.testing.assert_allclose(gaussians.means, means, rtol=1e-6)
    colours = 0.5 + SH_0 * gaussians.sh[:, 0].reshape(*done.depth.shape, 3).transpose(0, 3, 1, 2)
    np.testing.assert_allclose(colours, views.images, atol=1e-5)


def test_gaussians_keep_their_share_of_a_pixel() -> None:
    predictor, views = PlanePredictor(), large_views()
    done = predict_enlarged(predictor, views, 1.0, 30.0)
    height, width = predictor.sizes[0]
    # Each had the size 1 at its depth in the smaller images, which is nearly that of the same place in the larger ones.
    np.testing.assert_allclose(done.need_gaussians().scales, np.sqrt(height * width / (HEIGHT * WIDTH)), rtol=0.02)


def test_cameras_are_those_of_the_larger_depth_maps() -> None:
    done = predict_enlarged(PlanePredictor(), large_views(), 1.0, 30.0)
    for camera in done.cameras:
        assert (camera.height, camera.width) == (HEIGHT, WIDTH)
        np.testing.assert_allclose(camera.K, K, rtol=1e-6)


def test_a_model_of_depth_alone_is_enlarged_as_well() -> None:
    done = predict_enlarged(PlanePredictor(gaussians=False), large_views(), 1.0, 30.0)
    assert done.gaussians is None and done.depth.shape == (2, HEIGHT, WIDTH)


def test_images_that_suit_the_network_are_predicted_as_they_are() -> None:
    images = np.zeros((2, 3, 64, 96), np.float32)
    predictor = PlanePredictor()
    done = predict_enlarged(predictor, views_in_a_row(images, [0, 1], K), 1.0, 30.0)
    assert predictor.sizes == [(64, 96)] and done.depth.shape == (2, 64, 96)


@pytest.mark.parametrize("count", [2, 7])
def test_all_groups_of_views_are_enlarged_if_asked(count: int) -> None:
    predictor, views, span = PlanePredictor(), large_views(count), DepthRange(1.0, 30.0, "given")
    done = predict_views(predictor, views, span, for_fusion=True)
    assert done.depth.shape == (count, HEIGHT, WIDTH) and len(done.need_gaussians()) == done.depth.size
    assert set(predictor.sizes) == {network_size(model(), HEIGHT, WIDTH)}
    predictor.sizes.clear()
    predict_views(predictor, views, span)
    assert set(predictor.sizes) == {(HEIGHT, WIDTH)}
