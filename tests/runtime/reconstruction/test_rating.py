"""The choice among several predictions of a view, on a plane that five cameras see."""

from dataclasses import replace

import numpy as np
from idesplat.runtime.inference.predictor import Prediction
from idesplat.runtime.reconstruction.patches import WINDOW
from idesplat.runtime.reconstruction.rating import DepthRating
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.views.batch import ViewBatch
from views_in_a_row import views_in_a_row

VIEWS, HEIGHT, WIDTH = 5, 32, 48
PLANE = 10.0
WRONG = 6.0
K = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]])


def plane_views(colors: np.ndarray | None = None) -> ViewBatch:
    """Cameras beside each other before the plane, of one colour each, [views, 3]; gray by default."""
    gray = np.full((VIEWS, 3), 0.5, np.float32)
    images = np.ones((VIEWS, 3, HEIGHT, WIDTH), np.float32) * (gray if colors is None else colors)[..., None, None]
    return views_in_a_row(images, 0.3 * np.arange(VIEWS), K)


def rating(views: ViewBatch) -> DepthRating:
    """All views have the plane as their surface, and each is asked about the others."""
    depth = np.full((VIEWS, HEIGHT, WIDTH), PLANE, np.float32)
    return DepthRating(depth, views, [np.delete(np.arange(VIEWS), view) for view in range(VIEWS)])


def predicted(depth: np.ndarray, gaussians: bool = True) -> Prediction:
    """A prediction of one view whose Gaussians have their depth as opacity, a tenth of it."""
    flat = depth.ravel().astype(np.float32)
    values = Gaussians(
        np.repeat(flat[:, None], 3, 1),
        np.ones((flat.size, 3), np.float32),
        np.ones((flat.size, 4), np.float32),
        flat / 10,
        np.zeros((flat.size, 1, 3), np.float32),
    )
    return Prediction(depth[None].astype(np.float32), values if gaussians else None)


def halves(left: float, right: float) -> np.ndarray:
    """A depth map with one depth on each side."""
    depth = np.full((HEIGHT, WIDTH), left)
    depth[:, WIDTH // 2 :] = right
    return depth


def test_each_pixel_is_of_the_prediction_that_the_other_views_agree_with() -> None:
    best = rating(plane_views()).best(
        2, [predicted(halves(PLANE, WRONG)), predicted(halves(WRONG, PLANE)), predicted(halves(4, 5))]
    )
    edge = WIDTH // 2
    inner = np.abs(np.arange(WIDTH) - edge) > WINDOW
    assert best.depth.shape == (1, HEIGHT, WIDTH)
    np.testing.assert_array_equal(best.depth[0][:, inner], PLANE)
    np.testing.assert_array_equal(best.need_gaussians().opacities, best.depth.ravel() / 10)


def test_equal_predictions_leave_that_of_the_own_group() -> None:
    own, other = predicted(halves(PLANE, PLANE)), predicted(halves(PLANE + 0.1, PLANE + 0.1))
    best = rating(plane_views()).best(0, [own, other])
    np.testing.assert_array_equal(best.depth, own.depth)


def test_without_views_that_see_the_same_the_own_group_decides() -> None:
    own, other = predicted(halves(WRONG, WRONG)), predicted(halves(PLANE, PLANE))
    views = plane_views()
    apart = views.extrinsics.copy()
    apart[:, 0, 3] *= 1000
    best = rating(replace(views, extrinsics=apart)).best(0, [own, other])
    np.testing.assert_array_equal(best.depth, own.depth)


def test_agreement_in_depth_does_not_count_where_colours_differ() -> None:
    colors = np.full((VIEWS, 3), 0.1, np.float32)
    colors[2] = 0.9
    own, other = predicted(halves(WRONG, WRONG)), predicted(halves(PLANE, PLANE))
    np.testing.assert_array_equal(rating(plane_views(colors)).best(2, [own, other]).depth, own.depth)
    np.testing.assert_array_equal(rating(plane_views()).best(2, [own, other]).depth, other.depth)


def test_what_the_others_do_not_see_is_no_better_than_the_own_depth() -> None:
    """A depth behind the others' surfaces has no votes, one that half of the voters agree with has more support."""
    hidden = predicted(halves(2 * PLANE, 2 * PLANE))
    right = predicted(halves(PLANE, PLANE))
    np.testing.assert_array_equal(rating(plane_views()).best(2, [right, hidden]).depth, right.depth)
    np.testing.assert_array_equal(rating(plane_views()).best(2, [hidden, right]).depth, right.depth)


def test_models_of_depth_alone_have_a_choice_too() -> None:
    own, other = predicted(halves(WRONG, WRONG), gaussians=False), predicted(halves(PLANE, PLANE), gaussians=False)
    best = rating(plane_views()).best(1, [own, other])
    np.testing.assert_array_equal(best.depth, other.depth)
    assert best.gaussians is None
