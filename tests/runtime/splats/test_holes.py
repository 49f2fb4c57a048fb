"""Closing of holes: slanted surfaces stay closed from aside and from near, and edges have background behind them."""

import numpy as np
import pytest
from idesplat.runtime.geometry.intrinsics import denormalize_intrinsics
from idesplat.runtime.rendering.render import render_view
from idesplat.runtime.splats.backdrop import BEHIND, CELL, MAGNIFIED, MARGIN
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.holes import close_holes, close_view
from idesplat.runtime.splats.surfaces import Surfaces
from views_in_a_row import extrinsics_in_a_row

SIZE = 48
DISTANCE = 4.0
INTRINSICS = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], np.float32)
K = denormalize_intrinsics(INTRINSICS[None], SIZE, SIZE)[0]
PIXEL_SCALE = 0.45  # standard deviation in pixels, as the bundled model predicts it
MIDDLE = slice(12, 36)


def rays() -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T


def slanted(degrees: float) -> np.ndarray:
    """The depth of a plane through (0, 0, DISTANCE) that is turned about the y axis, [SIZE, SIZE]."""
    tangent = np.tan(np.radians(degrees))
    return (DISTANCE / (1 - tangent * rays()[..., 0])).astype(np.float32)


def pixel_sized(depth: np.ndarray, extrinsics: np.ndarray) -> tuple[Gaussians, Surfaces]:
    """A round opaque Gaussian of a pixel's size for each pixel, and the surfaces that they lie on."""
    points = rays() * depth[..., None] + extrinsics[:, None, None, :3, 3]
    count = depth.size
    scales = np.repeat(PIXEL_SCALE * depth.reshape(-1, 1) / K[0, 0], 3, axis=1)
    gaussians = Gaussians(
        points.reshape(-1, 3).astype(np.float32),
        scales.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 0.999, np.float32),
        np.full((count, 1, 3), 0.5, np.float32),
    )
    return gaussians, Surfaces(points, depth, extrinsics, np.tile(INTRINSICS, (len(depth), 1, 1)))


def close_surfaces(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray) -> Gaussians:
    """What `close_holes` gives but for the backdrop."""
    parts = [close_view(gaussians, surfaces, kept, view)[:2] for view in range(len(kept))]
    return Gaussians.concatenate([part for each in zip(*parts, strict=True) for part in each])


def closed(depth: np.ndarray, extrinsics: np.ndarray) -> tuple[Gaussians, Gaussians]:
    """Pixel-sized Gaussians before and after the closing of surfaces."""
    gaussians, surfaces = pixel_sized(depth, extrinsics)
    return gaussians, close_surfaces(gaussians, surfaces, np.ones(depth.shape, bool))


def orbiting(degrees: float) -> np.ndarray:
    """A camera turned about (0, 0, DISTANCE), which it looks at, camera-to-world [4, 4]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = [0, 0, DISTANCE] - pose[:3, :3] @ [0, 0, DISTANCE]
    return pose


def approached() -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = DISTANCE / 2
    return pose


def least_alpha(gaussians: Gaussians, pose: np.ndarray) -> float:
    return float(render_view(gaussians, pose, K, SIZE, SIZE).alpha[MIDDLE, MIDDLE].min())


@pytest.mark.parametrize(
    ("degrees", "pose"),
    [(45, orbiting(-45)), (45, orbiting(20)), (60, orbiting(-45)), (0, orbiting(45)), (0, approached())],
    ids=["slanted, seen frontally", "slanted, seen flatter", "steep, from aside", "frontal, from aside", "from near"],
)
def test_a_plane_stays_closed(degrees: float, pose: np.ndarray) -> None:
    before, surfaces = pixel_sized(slanted(degrees)[None], extrinsics_in_a_row(0))
    after = close_holes(before, surfaces, np.ones((1, SIZE, SIZE), bool))
    assert least_alpha(after, pose) > 0.95
    assert least_alpha(after, pose) > least_alpha(before, pose)


def test_round_gaussians_leave_holes() -> None:
    """What the test above shows is not so without it."""
    before, _ = closed(slanted(45)[None], extrinsics_in_a_row(0))
    assert least_alpha(before, orbiting(-45)) < 0.9


def test_shear_along_the_rays_keeps_the_image_in_its_own_view() -> None:
    before, after = closed(slanted(30)[None], extrinsics_in_a_row(0))
    found, expected = (render_view(each, np.eye(4), K, SIZE, SIZE) for each in (after, before))
    np.testing.assert_allclose(found.rgb[MIDDLE, MIDDLE], expected.rgb[MIDDLE, MIDDLE], atol=0.005)
    np.testing.assert_allclose(after.means[: len(before.means)], before.means)


def patch_before_a_wall() -> np.ndarray:
    depth = np.full((1, SIZE, SIZE), 2 * DISTANCE, np.float32)
    depth[0, 14:34, 14:34] = DISTANCE
    return depth


def test_background_goes_on_behind_an_edge() -> None:
    """A camera beside the view sees the wall in the gap beside the patch."""
    before, after = closed(patch_before_a_wall(), extrinsics_in_a_row(0))
    assert len(after) > len(before)
    aside = extrinsics_in_a_row(0.4)[0]
    around = slice(14, 34), slice(5, 43)  # the patch, not the borders of the image
    gaps = [float((render_view(g, aside, K, SIZE, SIZE).alpha[around] < 0.5).sum()) for g in (before, after)]
    assert gaps[0] > 15 and gaps[1] == 0


def test_what_is_added_is_hidden_from_the_view_itself() -> None:
    before, after = closed(patch_before_a_wall(), extrinsics_in_a_row(0))
    added = after.means[len(before) :]
    assert (added[:, 2] > DISTANCE * 1.05).all()
    row, column = (np.floor(added[:, axis] / added[:, 2] * K[0, 0] + SIZE / 2).astype(int) for axis in (1, 0))
    assert (patch_before_a_wall()[0][row, column] == DISTANCE).all()


def test_nothing_is_added_where_another_view_looks() -> None:
    """A second camera that sees the wall beside the patch has nothing put before it."""
    gaussians, surfaces = pixel_sized(np.concatenate([patch_before_a_wall()] * 2), extrinsics_in_a_row(0, 0))
    surfaces.depth[1] = 20 * DISTANCE
    after = close_surfaces(gaussians, surfaces, np.ones(surfaces.depth.shape, bool))
    assert len(after) == len(gaussians)


def test_removed_pixels_stay_removed() -> None:
    gaussians, surfaces = pixel_sized(slanted(20)[None], extrinsics_in_a_row(0))
    kept = np.ones((1, SIZE, SIZE), bool)
    kept[0, :10] = False
    assert len(close_surfaces(gaussians, surfaces, kept)) == kept.sum()


def with_backdrop(
    depth: np.ndarray, extrinsics: np.ndarray, kept: np.ndarray | None = None
) -> tuple[Gaussians, Gaussians]:
    """What closes the surfaces, and the backdrop that `close_holes` adds to it."""
    gaussians, surfaces = pixel_sized(depth, extrinsics)
    kept = np.ones(depth.shape, bool) if kept is None else kept
    closed, whole = (close(gaussians, surfaces, kept) for close in (close_surfaces, close_holes))
    return closed, whole.select(np.arange(len(closed), len(whole)))


def test_a_backdrop_covers_what_no_view_sees() -> None:
    """Beyond the frame, and behind a patch from far aside; the view itself does not see it."""
    closed, backdrop = with_backdrop(patch_before_a_wall(), extrinsics_in_a_row(0))
    whole = Gaussians.concatenate([closed, backdrop])
    aside = extrinsics_in_a_row(0.8)[0]  # a tenth of the frame is beyond the wall's border
    alphas = [render_view(each, aside, K, SIZE, SIZE).alpha for each in (closed, whole)]
    assert alphas[0].min() < 0.01 and alphas[1].min() > 0.7
    own = [render_view(each, np.eye(4), K, SIZE, SIZE).rgb[MIDDLE, MIDDLE] for each in (closed, whole)]
    np.testing.assert_allclose(own[0], own[1], atol=0.01)


def test_a_backdrop_lies_behind_the_farthest_surface_around() -> None:
    _, backdrop = with_backdrop(patch_before_a_wall(), extrinsics_in_a_row(0))
    np.testing.assert_allclose(backdrop.means[:, 2], 2 * DISTANCE * (1 + BEHIND), rtol=1e-5)
    side = SIZE / CELL + 2 * np.ceil(MARGIN * SIZE / CELL)
    assert len(backdrop) == side**2


def test_a_backdrop_has_the_colour_of_the_background() -> None:
    depth = patch_before_a_wall()
    gaussians, surfaces = pixel_sized(depth, extrinsics_in_a_row(0))
    gaussians.sh[depth.ravel() == DISTANCE] = -1.0
    kept = np.ones(depth.shape, bool)
    added = close_holes(gaussians, surfaces, kept).sh[len(close_surfaces(gaussians, surfaces, kept)) :]
    np.testing.assert_allclose(added, 0.5, atol=1e-5)


def test_no_backdrop_where_another_view_looks_or_all_is_removed() -> None:
    depth = np.concatenate([patch_before_a_wall()] * 2)
    depth[1] = 20 * DISTANCE
    _, backdrop = with_backdrop(depth, extrinsics_in_a_row(0, 0))
    assert (backdrop.means[:, 2] > 20 * DISTANCE).sum() > 0
    inside = np.abs(backdrop.means[:, :2] / backdrop.means[:, 2:]).max(axis=1) < 0.5
    assert (backdrop.means[inside, 2] > 20 * DISTANCE).all()
    kept = np.ones(depth.shape, bool)
    kept[0] = False
    _, backdrop = with_backdrop(depth, extrinsics_in_a_row(0, 0), kept)
    assert (backdrop.means[:, 2] > 20 * DISTANCE).all()


@pytest.mark.parametrize("distance", [0.5, 1.0])
def test_no_backdrop_right_before_a_camera(distance: float) -> None:
    """A camera behind a wall's backdrop that looks away from it; the cells farther than a fifth of the depth stay."""
    wall = DISTANCE * (1 + BEHIND)
    extrinsics = extrinsics_in_a_row(0, 0)
    extrinsics[1, 2, 3] = wall + distance
    _, backdrop = with_backdrop(np.stack([slanted(0)] * 2), extrinsics)
    beyond = int(np.ceil(MARGIN * SIZE / CELL))  # cells on each side of the frame
    cells = (np.arange(-beyond, SIZE // CELL + beyond) + 0.5) * CELL - SIZE / 2
    aside = np.hypot(*np.meshgrid(cells, cells)) * wall / K[0, 0]
    expected = np.sort(aside[np.hypot(aside, distance) > wall / MAGNIFIED])
    found = backdrop.means[np.isclose(backdrop.means[:, 2], wall)]
    np.testing.assert_allclose(np.sort(np.hypot(found[:, 0], found[:, 1])), expected, rtol=1e-5)
    assert (len(expected) < aside.size) == (distance < wall / MAGNIFIED)


def test_views_of_one_surface_mix() -> None:
    """Of a plane that two views show in two greys, a camera between them sees a grey nearer to the middle of both."""
    before, surfaces = pixel_sized(np.concatenate([slanted(0)[None]] * 2), extrinsics_in_a_row(-0.1, 0.1))
    before.sh[: SIZE * SIZE] += 0.5
    after = close_surfaces(before, surfaces, np.ones((2, SIZE, SIZE), bool))
    middle = before.colours.mean()
    shown = [render_view(each, np.eye(4), K, SIZE, SIZE).rgb[MIDDLE, MIDDLE].mean() for each in (before, after)]
    assert abs(shown[1] - middle) < 0.95 * abs(shown[0] - middle)


@pytest.mark.parametrize("pose", [np.eye(4), orbiting(45), approached()], ids=["frontal", "from aside", "from near"])
def test_smaller_gaussians_of_two_views_close_a_plane(pose: np.ndarray) -> None:
    """Of three views of a plane two copies are kept: as much smaller as they may be, no camera sees between them."""
    before, surfaces = pixel_sized(np.concatenate([slanted(0)[None]] * 3), extrinsics_in_a_row(-0.1, 0.1, 0))
    kept = np.ones((3, SIZE, SIZE), bool)
    kept[2] = False
    after = close_surfaces(before, surfaces, kept)
    assert np.median(after.scales) < np.median(before.scales)
    assert least_alpha(after, pose) > 0.95


@pytest.mark.parametrize("second", [None, 20 * DISTANCE], ids=["one view", "another view sees through it"])
def test_a_surface_of_one_view_stays_opaque(second: float | None) -> None:
    views = 1 if second is None else 2
    before, surfaces = pixel_sized(np.concatenate([slanted(0)[None]] * views), extrinsics_in_a_row(*[0] * views))
    if second is not None:
        surfaces.depth[1] = second
    after, _, _ = close_view(before, surfaces, np.ones((views, SIZE, SIZE), bool), 0)
    np.testing.assert_array_equal(after.opacities, before.opacities[: SIZE * SIZE])


@pytest.mark.parametrize("views", [3, 4, 6])
def test_all_views_of_a_surface_together_let_a_hundredth_of_the_light_through(views: int) -> None:
    before, surfaces = pixel_sized(np.concatenate([slanted(0)[None]] * views), extrinsics_in_a_row(*[0] * views))
    before.opacities[:] = 1
    after, _, _ = close_view(before, surfaces, np.ones((views, SIZE, SIZE), bool), 0)
    np.testing.assert_allclose((1 - after.opacities) ** views, 0.01, rtol=1e-4)


def test_of_many_views_one_that_sees_through_a_gaussian_takes_its_share_of_the_opacity() -> None:
    """A view alone against one keeps half of it; with two views it does not tell which of them is wrong."""
    before, surfaces = pixel_sized(np.concatenate([slanted(0)[None]] * 3), extrinsics_in_a_row(0, 0, 100))
    surfaces.depth[1] = 20 * DISTANCE
    after, _, _ = close_view(before, surfaces, np.ones((3, SIZE, SIZE), bool), 0)
    np.testing.assert_allclose(after.opacities, before.opacities[: SIZE * SIZE] / 2)
