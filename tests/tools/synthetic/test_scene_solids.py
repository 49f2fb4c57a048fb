"""Cut and free-form solids, far skies and window light, against computations in NumPy."""

from collections.abc import Callable

import numpy as np
import pytest
from grey_scenes import GREY, WIDE_ANGLE, less, pixel_rays, rotation_about_y, scene_of
from idesplat.tools.synthetic.builder import SceneBuilder, add_room, cut_out, daylit_scene, form_steepness
from idesplat.tools.synthetic.layout import LAYOUTS, TRAINING_LAYOUTS
from idesplat.tools.synthetic.objects import ALONG_Z, add_bright_windows
from idesplat.tools.synthetic.outdoor import facade, hills, ruins, street_under_far_sky
from idesplat.tools.synthetic.raycast import BOX, CYLINDER, ELLIPSOID, FREE_FORM, LUMINOUS, _face
from idesplat.tools.synthetic.sampler import scene_textures
from idesplat.tools.synthetic.scene import WAVES, Scene
from idesplat.tools.synthetic.views import look_at, render

Implicit = Callable[[np.ndarray], np.ndarray]  # of points [..., 3], negative inside
SIDE = 64  # pixels
CENTRE, HALVES = np.array([0.2, 0.1, 4.0]), np.array([1.5, 1.0, 0.7])
AXES = rotation_about_y(25.0) @ np.array([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
SAMPLES = 3000  # along a ray
TILT = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])

PRIMITIVES: dict[int, Implicit] = {
    BOX: lambda p: np.abs(p).max(axis=-1) - 1,
    ELLIPSOID: lambda p: np.linalg.norm(p, axis=-1) - 1,
    CYLINDER: lambda p: np.maximum(np.hypot(p[..., 0], p[..., 2]), np.abs(p[..., 1])) - 1,
}
# Solid, cut, its centre, half extents and axes in the solid's unit frame.
CUTS = {
    "niche": (BOX, BOX, (0.1, 0.2, -0.9), (0.6, 0.5, 0.8), np.eye(3)),
    "opening": (BOX, BOX, (0.3, 0.4, 0.0), (0.4, 0.8, 1.5), np.eye(3)),
    "tilted notch": (BOX, BOX, (-0.6, -0.8, -0.3), (0.5, 0.5, 0.9), TILT),
    "bore": (BOX, CYLINDER, (0.0, 0.1, 0.0), (0.7, 1.5, 0.6), ALONG_Z),
    "pipe": (CYLINDER, CYLINDER, (0.0, 0.0, 0.0), (0.8, 1.5, 0.8), np.eye(3)),
    "bored ball": (ELLIPSOID, CYLINDER, (0.1, 0.0, 0.0), (0.5, 1.5, 0.4), ALONG_Z),
    "dent": (CYLINDER, ELLIPSOID, (0.2, 0.1, -0.9), (0.5, 0.6, 0.7), np.eye(3)),
}


def cut_scene(name: str) -> tuple[Scene, Implicit]:
    """A scene with one of CUTS, and the solid's implicit function in its unit frame."""
    shape, cut_shape, centre, half, axes = CUTS[name]
    scene = less(scene_of((shape, tuple(CENTRE), tuple(HALVES), AXES)), cut_out(cut_shape, centre, half, axes))

    def implicit(points: np.ndarray) -> np.ndarray:
        removed = PRIMITIVES[cut_shape]((points - centre) @ axes.T / half)
        return np.maximum(PRIMITIVES[shape](points), -removed)

    return scene, implicit


def form_scene(squareness: float) -> tuple[Scene, Implicit]:
    """A scene with a free-form solid of two waves, and its implicit function in the unit frame."""
    scene = scene_of((FREE_FORM, tuple(CENTRE), tuple(HALVES), AXES))
    waves, forms = np.zeros((2, WAVES, 5)), np.zeros((2, 2))
    waves[1, 0], waves[1, 1] = (0.4, -0.3, 0.2, 0.1, 0.5), (-0.6, 0.2, 0.7, 0.05, 0.3)
    forms[1] = squareness, form_steepness(waves[1])

    def implicit(points: np.ndarray) -> np.ndarray:
        by_two, by_four = (np.linalg.norm(points, ord=order, axis=-1) for order in (2, 4))
        value = (1 - squareness) * by_two + squareness * by_four - 1
        for k_x, k_z, phase, height, k_y in waves[1, :2]:
            turn = (points @ (k_x, k_y, k_z) + phase + 0.5) % 1 - 0.5
            value = value + height * (1 + np.where(turn > 0, 16 * turn * (0.5 - turn), 16 * turn * (0.5 + turn)))
        return value

    return scene._replace(waves=waves, forms=forms), implicit


def first_surface(implicit: Implicit, rays: np.ndarray, near: float, far: float) -> np.ndarray:
    """The first sign change along rays [..., 3] from the origin of the world, by sampling and bisection; 0 if none."""

    def value(z: np.ndarray) -> np.ndarray:
        points = rays * z[..., None] if z.shape == rays.shape[:-1] else rays * z
        return implicit((points - CENTRE) @ AXES.T / HALVES)

    steps = np.linspace(near, far, SAMPLES)
    low, found = np.zeros(rays.shape[:-1]), np.zeros(rays.shape[:-1], bool)
    for start in steps[:-1]:
        hit = ~found & (value(np.full_like(low, start + steps[1] - steps[0])) < 0)
        low[hit], found = start, found | hit
    high = low + steps[1] - steps[0]
    for _ in range(40):
        middle = (low + high) / 2
        inside = value(middle) < 0
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.where(found, high, 0.0)


def assert_depth_is_that_of(implicit: Implicit, scene: Scene) -> None:
    _, depth = render(scene, GREY, np.eye(4), WIDE_ANGLE, SIDE, SIDE, 0)
    expected = first_surface(implicit, pixel_rays(WIDE_ANGLE, SIDE, SIDE), 2.0, 6.5)
    seen = depth < 9  # in front of the room's walls
    assert (seen == (expected > 0)).mean() > 0.998  # but for chords shorter than the steps
    both = seen & (expected > 0)
    assert both.mean() > 0.08
    close = np.abs(depth[both] / expected[both] - 1) < 1e-5
    assert close.mean() > 0.998


def assert_normals_are_gradients(implicit: Implicit, scene: Scene) -> None:
    """`_face` gives the direction of the gradient of the implicit function at the points that are seen."""
    _, depth = render(scene, GREY, np.eye(4), WIDE_ANGLE, SIDE, SIDE, 0)
    points = (pixel_rays(WIDE_ANGLE, SIDE, SIDE) * depth[..., None])[depth < 9]
    unit = (points.astype(float) - CENTRE) @ AXES.T / HALVES
    step = 1e-5
    slopes = np.stack(
        [(implicit(unit + step * axis) - implicit(unit - step * axis)) / (2 * step) for axis in np.eye(3)], axis=-1
    )
    # Depth is rounded to float32: go to the surface before asking for the normal there.
    for _ in range(3):
        unit = unit - implicit(unit)[:, None] * slopes / (slopes**2).sum(-1, keepdims=True)
    expected = slopes / HALVES
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = np.array([_face(scene, 1, *point)[1:] for point in unit])
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    assert (np.abs((found * expected).sum(1)) > 1 - 1e-6).mean() > 0.97  # but for points within a step of an edge


@pytest.mark.parametrize("name", CUTS)
def test_cut_solids(name: str) -> None:
    scene, implicit = cut_scene(name)
    assert_depth_is_that_of(implicit, scene)
    assert_normals_are_gradients(implicit, scene)
    _, whole = render(scene._replace(cut_shapes=np.array([-1, -1])), GREY, np.eye(4), WIDE_ANGLE, SIDE, SIDE, 0)
    _, cut = render(scene, GREY, np.eye(4), WIDE_ANGLE, SIDE, SIDE, 0)
    assert (cut > 1.01 * whole).mean() > 0.01


@pytest.mark.parametrize("squareness", [0.0, 0.5, 1.0])
def test_free_form_solids(squareness: float) -> None:
    scene, implicit = form_scene(squareness)
    assert_depth_is_that_of(implicit, scene)
    assert_normals_are_gradients(implicit, scene)


def test_steepness_bounds_the_slope_of_a_free_form_solid() -> None:
    """Otherwise the ray caster would step over the surface."""
    scene, implicit = form_scene(0.5)
    points = np.random.default_rng(0).uniform(-1, 1, (10000, 3))
    steps = 1e-4 * np.eye(3)
    slopes = np.stack([(implicit(points + step) - implicit(points - step)) / 2e-4 for step in steps], axis=-1)
    steepest = np.linalg.norm(slopes, axis=1).max()
    assert 0.7 * scene.forms[1, 1] < steepest <= scene.forms[1, 1]


def test_far_sun_casts_shadows_of_what_stands_on_the_ground() -> None:
    """A low box, under a sun at 2 km, whose shadow is right at its foot."""
    slab = scene_of((BOX, (0.0, 9.5, 0.0), (2.0, 0.2, 2.0), np.eye(3)))
    sun = slab._replace(light_positions=np.array([[1500.0, -1500.0, 0.0]]))
    above = look_at(np.array([0.0, 0.0, -1.0]), np.array([0.0, 9.0, 0.0]))
    lit, depth = render(sun, GREY, above, np.array([[0.8, 0, 0.5], [0, 0.8, 0.5], [0, 0, 1]]), 96, 96, 1)
    rays = pixel_rays(np.array([[0.8, 0, 0.5], [0, 0.8, 0.5], [0, 0, 1]]), 96, 96)
    x, y, z = np.moveaxis(rays * depth[..., None] @ above[:3, :3].T + above[:3, 3], -1, 0)
    floor = (y > 9.999) & (np.abs(z) < 1.9)
    # The light falls at 45 degrees: the shadow of the upper edge, 0.7 above the floor, ends 0.7 beyond the slab's side.
    shadow, open_floor = floor & (x < -2.05) & (x > -2.65), floor & (x < -2.8) & (x > -4)
    assert shadow.sum() > 10 and open_floor.sum() > 10
    np.testing.assert_allclose(lit[shadow], 0.25 * 128 / 255, rtol=1e-3)
    assert lit[open_floor].min() > 1.5 * lit[shadow].max()


def is_sky(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Which pixels see the enclosing ellipsoid, [height, width]. pose: camera-to-world, [4, 4]."""
    points = pixel_rays(intrinsics, *depth.shape) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
    return np.linalg.norm(points, axis=-1) > 0.9999 * scene.halves[0, 0]


@pytest.mark.parametrize(("layout_of", "distance"), [(street_under_far_sky, 5), (facade, 6), (hills, 6), (ruins, 4)])
def test_far_sky_has_almost_no_parallax(layout_of: Callable, distance: float) -> None:
    """Between cameras 0.3 times the viewing distance apart, its image moves by a pixel of 256 at most."""
    bank = scene_textures(0)
    layouts = [layout_of(np.random.default_rng(seed), bank) for seed in range(12)]
    far = [layout for layout in layouts if layout.scene.shapes[0] == ELLIPSOID]
    assert len(far) >= 4
    intrinsics, seen = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]]), []
    for layout in far:
        eye = layout.eye_bounds.mean(axis=0)
        pose = look_at(eye, eye + np.array([0.3, -0.3, 1.0]))
        other = pose.copy()
        other[:3, 3] += 0.3 * distance * pose[:3, 0]
        (first, depth), (second, depth_there) = (
            render(layout.scene, bank, view, intrinsics, 256, 256, 1) for view in (pose, other)
        )
        radius = layout.scene.halves[0, 0]
        sky = is_sky(layout.scene, pose, intrinsics, depth)
        assert radius >= 79 * distance
        assert (256 * 0.3 * distance < 1.3 * depth[sky]).all()  # disparity in pixels
        seen.append(sky.mean())
        both = sky & (depth_there > 0.8 * radius)
        if both.mean() > 0.02:
            assert np.abs(first - second)[both].mean() < 0.02
    assert max(seen) > 0.2


def test_far_sky_is_lit_by_nothing_and_ground_reaches_it() -> None:
    bank = scene_textures(0)
    scene = next(
        scene for seed in range(20) if (scene := ruins(np.random.default_rng(seed), bank).scene).shapes[0] == ELLIPSOID
    )
    assert scene.emissions[scene.materials[0, 0]] >= LUMINOUS
    pose = look_at(np.array([0.0, -2.0, -3.0]), np.array([0.0, -3.0, 5.0]))
    no_light = {"light_colours": np.zeros((1, 3)), "ambient": np.zeros(3), "speculars": np.zeros_like(scene.speculars)}
    dark = scene._replace(**no_light)
    (lit, depth), (unlit, _) = (render(part, bank, pose, WIDE_ANGLE, 96, 96, 1) for part in (scene, dark))
    sky = is_sky(scene, pose, WIDE_ANGLE, depth)
    assert sky.mean() > 0.1 and lit[sky].mean() > 0.3
    np.testing.assert_array_equal(unlit[sky], lit[sky])
    assert unlit[~sky].max() == 0
    level = look_at(np.array([0.0, -2.0, -3.0]), np.array([100.0, -2.0, 0.0]))
    _, depth = render(scene, bank, level, np.array([[20.0, 0, 0.5], [0, 20.0, 0.5], [0, 0, 1]]), 96, 96, 0)
    assert depth[90].max() > 2.0 * 20 / 0.5  # ground, just below the horizon
    assert depth[:, 48].max() < 1.1 * scene.halves[0, 0]


def test_windows_light_the_near_side_of_a_room() -> None:
    bank = scene_textures(0)
    for seed in range(6):
        builder = SceneBuilder(np.random.default_rng(seed), bank)
        width, height, length = add_room(builder)
        windows = add_bright_windows(builder, 0, width, length)
        scene = daylit_scene(builder, width, height, length, windows)
        count = len(scene.textures)
        grey = scene._replace(textures=np.zeros(count, int), colours=np.stack([np.eye(3, 4)] * count))
        pose = look_at(np.array([0.0, -1.4, 0.0]), np.array([width, -1.4, 0.0]))
        pinhole = np.array([[0.35, 0, 0.5], [0, 0.35, 0.5], [0, 0, 1]])
        image, depth = render(grey, GREY, pose, pinhole, 96, 96, 1)
        points = pixel_rays(pinhole, 96, 96) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
        wall = np.abs(points[..., 0] - width / 2) < 1e-3
        near, far = (wall & (points[..., 2] * side > 0.2 * length) for side in (-1, 1))
        assert near.sum() > 20 and far.sum() > 20
        assert image[near].mean() > 1.4 * image[far].mean(), seed
        assert all(np.abs(position[:2] - (0, -1.45)).max() < width for position in windows)
        # Lights are in front of the window's wall, inside the room.
        assert all(-length / 2 < position[2] < -length / 2 + 0.5 for position in windows)


def test_new_layouts_are_used_in_training_alone() -> None:
    new = {"street_under_far_sky", "ruins", "sculpture", "daylit_room", "still_life"}
    assert new <= {layout.__name__ for layout in TRAINING_LAYOUTS}
    assert not new & {layout.__name__ for layout in LAYOUTS}
