"""Synthetic scenes: exact depth, consistent views, disjoint seeds."""

from itertools import pairwise

import numpy as np
import pytest
from grey_scenes import GREY, WIDE_ANGLE, less, pixel_rays, rotation_about_y, scene_of
from idesplat.tools.synthetic.builder import cut_out
from idesplat.tools.synthetic.indoor import furnished_room
from idesplat.tools.synthetic.raycast import BOX, CYLINDER, ELLIPSOID, HEIGHT_FIELD
from idesplat.tools.synthetic.sampler import (
    HELD_OUT_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    Sample,
    _motion_kernel,
    generate_sample,
    scene_textures,
)
from idesplat.tools.synthetic.scene import WAVES
from idesplat.tools.synthetic.textures import LEVELS, SIZE, texture_bank
from idesplat.tools.synthetic.views import look_at, render


def test_depth_of_walls_is_analytic() -> None:
    pose = look_at(np.array([1.0, -2.0, -3.0]), np.array([4.0, 1.0, 5.0]), roll=0.3)
    _, depth = render(scene_of(), GREY, pose, WIDE_ANGLE, 40, 56, 0)
    rays = pixel_rays(WIDE_ANGLE, 40, 56) @ pose[:3, :3].T
    to_walls = np.where(rays > 0, 10 - pose[:3, 3], -10 - pose[:3, 3]) / rays
    np.testing.assert_allclose(depth, to_walls.min(axis=-1), rtol=1e-6)


def test_depth_of_solids_is_analytic() -> None:
    """The centre pixel looks along z at solids of known extent; a card has one z-depth, not one distance."""
    straight = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])
    fronts = {
        (BOX, 0.0): 4 - 0.5,
        (BOX, 45.0): 4 - 0.5 / np.cos(np.pi / 4),  # the ray meets the long face at a slant
        (ELLIPSOID, 0.0): 4 - 0.5,
        (CYLINDER, 90.0): 4 - 1.5,
    }
    for (shape, degrees), expected in fronts.items():
        scene = scene_of((shape, (0.0, 0.0, 4.0), (1.5, 0.8, 0.5), rotation_about_y(degrees)))
        _, depth = render(scene, GREY, np.eye(4), straight, 33, 33, 0)
        assert depth[16, 16] == pytest.approx(expected, rel=1e-6), (shape, degrees)
    # A card that faces the camera has one z-depth all over.
    card = scene_of((BOX, (0.0, 0.0, 4.0), (1.0, 1.0, 0.01), np.eye(3)))
    _, depth = render(card, GREY, np.eye(4), straight, 64, 64, 0)
    np.testing.assert_allclose(depth[20:44, 20:44], 3.99, rtol=1e-6)
    assert (depth == np.float32(3.99)).mean() == pytest.approx((2 / 3.99) ** 2, rel=0.05)


def test_what_is_cut_out_of_a_solid_is_hollow() -> None:
    """From above into a drum: a ball of radius .9 about the middle of its open side leaves a rim and a round floor."""
    above = look_at(np.array([0.0, -4.0, 1e-6]), np.array([0.0, 0.0, 0.0]))
    square = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])
    drum = scene_of((CYLINDER, (0.0, 0.0, 0.0), (2.0, 1.0, 2.0), np.eye(3)))
    drum = less(drum, cut_out(ELLIPSOID, (0.0, -1.0, 0.0), (0.9, 0.9, 0.9)))
    _, depth = render(drum, GREY, above, square, 65, 65, 0)
    assert depth[32, 32] == pytest.approx(4 - 1 + 0.9, rel=1e-6)  # the open side is 3 away; half the drum's height is 1
    rays = pixel_rays(square, 65, 65)
    points = rays * depth[..., None]  # x, y across, z down from the camera
    across = np.hypot(points[..., 0], points[..., 1])
    top = np.abs(points[..., 2] - 3) < 1e-5
    assert ((across[top] > 1.8) & (across[top] < 2.0)).all() and top.sum() > 50
    hollow = across < 1.75
    ball = (across[hollow] / 2 / 0.9) ** 2 + ((points[..., 2][hollow] - 3) / 0.9) ** 2
    np.testing.assert_allclose(ball, 1, atol=1e-4)


def test_light_in_a_hollow_comes_from_the_lamp() -> None:
    """The floor of a cut faces the lamp above as a flat top does: it is as bright."""
    above = look_at(np.array([0.0, -4.0, 1e-6]), np.array([0.0, 0.0, 0.0]))
    square = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])
    drum = scene_of((BOX, (0.0, 0.0, 0.0), (2.0, 1.0, 2.0), np.eye(3)))
    hollow = less(drum, cut_out(ELLIPSOID, (0.0, -1.0, 0.0), (0.9, 0.9, 0.9)))
    flat, cut = (render(scene, GREY, above, square, 65, 65, 1)[0][32, 32] for scene in (drum, hollow))
    np.testing.assert_allclose(cut, flat, rtol=1e-3)


def test_depth_of_a_height_field_is_that_of_its_waves() -> None:
    """Hits lie on y = a p(k x): parabolas between -a and a, computed here from their definition."""
    field = scene_of((HEIGHT_FIELD, (0.0, 0.0, 0.0), (3.0, 0.5, 3.0), np.eye(3)))
    waves = np.zeros((2, WAVES, 5))
    waves[1, 0] = 0.5, 0.0, 0.0, 0.8, 0.0
    pose = look_at(np.array([0.5, -3.0, -4.0]), np.array([0.0, 0.0, 0.0]))
    _, depth = render(field._replace(waves=waves), GREY, pose, WIDE_ANGLE, 96, 96, 0)
    points = pixel_rays(WIDE_ANGLE, 96, 96) * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]
    on_field = (np.abs(points[..., [0, 2]]) < 2.999).all(axis=-1) & (np.abs(points[..., 1]) < 0.499)
    assert on_field.mean() > 0.3
    x, y = points[on_field][:, 0] / 3, points[on_field][:, 1] / 0.5
    turn = 0.5 * x - np.floor(0.5 * x + 0.5)
    expected = 0.8 * np.where(turn > 0, 16 * turn * (0.5 - turn), 16 * turn * (0.5 + turn))
    np.testing.assert_allclose(y, expected, atol=1e-5)


def test_motion_blur_moves_nothing_in_the_mean() -> None:
    for length, angle in ((1.0, 0.3), (3.5, 1.2), (2.0, np.pi / 2)):
        kernel = _motion_kernel(length, angle).astype(float)
        y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
        assert kernel.sum() == pytest.approx(1) and kernel.min() >= 0
        assert (kernel * x).sum() == pytest.approx(0, abs=1e-6) and (kernel * y).sum() == pytest.approx(0, abs=1e-6)
        along = x * np.cos(angle) + y * np.sin(angle)
        # A line of this length has a variance of length^2 / 12; bilinear weights add up to .25 in each direction.
        assert 0 < (kernel * along**2).sum() - length**2 / 12 < 0.27


def test_solid_casts_the_analytic_shadow() -> None:
    above = look_at(np.array([0.0, 0.0, -8.0]), np.array([0.0, 9.0, 0.0]))
    square = np.array([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]])
    ball = scene_of((ELLIPSOID, (0.0, -4.0, 0.0), (2.0, 1.0, 2.0), np.eye(3)))
    with_ball, depth = render(ball, GREY, above, square, 48, 48, 4)
    without, empty_depth = render(scene_of(), GREY, above, square, 48, 48, 4)
    shaded = (with_ball < 0.8 * without).all(axis=-1) & (depth == empty_depth)
    points = pixel_rays(square, 48, 48) * depth[..., None] @ above[:3, :3].T + above[:3, 3]
    on_floor = points[..., 1] > 9.999
    from_middle = np.hypot(points[..., 0], points[..., 2])
    # The cone from the lamp that just touches the ball: it stands 5 above the centre, half axes 2 and 1 (down).
    slope = 2 / np.sqrt(5**2 - 1)
    assert shaded[on_floor & (from_middle < 0.97 * 19 * slope)].all()
    assert not shaded[on_floor & (from_middle > 1.03 * 19 * slope)].any()


def test_sample_depends_on_the_seed_alone() -> None:
    first, again, other = (generate_sample(seed, 2, 1, 32, 48) for seed in (7, 7, 8))
    for name in ("images", "depth", "extrinsics", "intrinsics", "near", "far"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert np.abs(first.images - other.images).mean() > 0.05
    assert np.abs(first.intrinsics - other.intrinsics).max() > 0.01


def test_zoomed_target_is_a_crop_of_the_larger_image() -> None:
    """Context and cameras are unchanged; the crop shows the same depth as the larger image."""
    plain, zoomed = (generate_sample(7, 2, 2, 64, 96, target_zooms=times) for times in ((), (1, 3)))
    large = generate_sample(7, 2, 2, 3 * 64, 3 * 96)
    assert np.array_equal(plain.extrinsics[:, :3, :3], zoomed.extrinsics[:, :3, :3])
    assert np.array_equal(plain.intrinsics[:3], zoomed.intrinsics[:3])
    corner = 3 * plain.intrinsics[3, :2, 2] - zoomed.intrinsics[3, :2, 2]  # in windows
    assert (corner >= 0).all() and (corner <= 2).all() and corner.max() > 0
    left, top = (corner * (96, 64)).round().astype(int)
    shown = large.depth[3, top : top + 64, left : left + 96] / large.depth[0].min()
    assert np.median(np.abs(zoomed.depth[3] / zoomed.depth[0].min() / shown - 1)) < 0.01


def test_samples_are_well_formed() -> None:
    samples = [generate_sample(seed, 2, 2, 24, 32) for seed in (*range(60), *HELD_OUT_SEEDS[:4])]
    for sample in samples:
        assert sample.images.shape == (4, 3, 24, 32) and sample.depth.shape == (4, 24, 32)
        assert all(part.dtype == np.float32 for part in (sample.images, sample.depth, sample.extrinsics))
        assert sample.images.min() >= 0 and sample.images.max() <= 1
        assert 0.1 < sample.images.mean() < 0.8
        assert sample.near < sample.depth.min() and sample.depth.max() <= sample.far
        rotations = sample.extrinsics[:, :3, :3].astype(np.float64)
        np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3)[None].repeat(4, 0), atol=1e-6)
        np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-6)
        assert sample.near == 1
    # A tight range is at most four times (1 / 0.5 times 2) as wide as the scene.
    wide = [sample.far > 4 * sample.depth.max() / sample.depth.min() for sample in samples]
    assert 0.1 < np.mean(wide) < 0.4
    flat = [np.ptp(np.log(sample.depth[0])) < 0.2 for sample in samples]
    assert np.mean(flat) < 0.2


def test_a_far_sky_of_training_is_at_far() -> None:
    samples = [generate_sample(seed, 2, 0, 24, 32) for seed in range(60)]
    assert max(sample.far for sample in samples) == 200
    assert any((sample.depth == np.float32(sample.far)).mean() > 0.05 for sample in samples)


def warped(sample: Sample, source: int, target: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Source's points projected into target: pixels [points, 2] inside the image, z-depths, colours, and a mask."""
    height, width = sample.depth.shape[1:]
    points = pixel_rays(sample.intrinsics[source], height, width) * sample.depth[source][..., None]
    relative = np.linalg.inv(sample.extrinsics[target].astype(np.float64)) @ sample.extrinsics[source]
    points = points.reshape(-1, 3) @ relative[:3, :3].T + relative[:3, 3]
    projected = points @ sample.intrinsics[target].T
    pixels = projected[:, :2] / projected[:, 2:] * (width, height) - 0.5
    inside = ((pixels > 0) & (pixels < (width - 1.001, height - 1.001))).all(axis=1) & (points[:, 2] > 0)
    colours = sample.images[source].reshape(3, -1).T
    return pixels[inside], points[inside, 2], colours[inside], inside


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6])
def test_views_are_consistent_under_their_depth(seed: int) -> None:
    """A reprojected pixel has the other view's depth and colour, or is occluded there; none lies in front."""
    sample = generate_sample(seed, 1, 2, 96, 96)
    pixels, z, colours, inside = warped(sample, 1, 2)
    assert inside.mean() > 0.3
    column, row = pixels.astype(int).T
    corners = [(row + i, column + j) for i in (0, 1) for j in (0, 1)]
    around = np.stack([sample.depth[2][corner] for corner in corners])
    fu, fv = pixels.T - (column, row)
    weights = np.stack([(1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu])
    # Inverse depth is linear across the image of a plane, so that interpolating it is exact there.
    smooth = np.ptp(np.log(around), axis=0) < 0.05
    seen = 1 / (weights / around).sum(axis=0)
    met = smooth & (np.abs(z / seen - 1) < 2e-3)
    assert (z[smooth] < 0.99 * seen[smooth]).mean() < 0.005  # in front of what the other view sees
    assert met.sum() > 0.6 * smooth.sum()
    other = np.stack([sample.images[2][:, corner_row, corner_column] for corner_row, corner_column in corners])
    difference = np.abs((weights[:, None] * other).sum(axis=0).T - colours)[met]
    unrelated = np.abs(colours[met] - colours[met][::-1])
    assert difference.mean() < 0.04
    assert difference.mean() < 0.4 * unrelated.mean()


def test_more_rays_per_pixel_reduce_the_error() -> None:
    """Antialiasing: four rays are better than one, and close to 64."""
    bank = scene_textures(0)
    rng = np.random.default_rng(0)
    layout = furnished_room(rng, bank)
    pose = look_at(layout.eye_bounds.mean(axis=0), layout.focus_bounds[1])
    one, four, many = (render(layout.scene, bank, pose, WIDE_ANGLE, 64, 64, count)[0] for count in (1, 4, 64))
    error_of_one, error_of_four = (np.sqrt(np.mean((image - many) ** 2)) for image in (one, four))
    assert error_of_four < 0.75 * error_of_one
    assert error_of_four < 0.03


def test_training_and_reported_seeds_are_disjoint() -> None:
    assert len(HELD_OUT_SEEDS) == 200
    ranges = sorted([TRAINING_SEEDS, VALIDATION_SEEDS, HELD_OUT_SEEDS], key=lambda seeds: seeds.start)
    assert all(before.stop <= after.start for before, after in pairwise(ranges))
    banks = [scene_textures(seeds[0]).texels for seeds in (TRAINING_SEEDS, HELD_OUT_SEEDS)]
    training = {texture.tobytes() for texture in banks[0]}
    assert not any(texture.tobytes() in training for texture in banks[1])
    assert scene_textures(VALIDATION_SEEDS[0]) is scene_textures(HELD_OUT_SEEDS[0])


def test_textures_tile_and_have_mipmaps() -> None:
    bank = texture_bank(3, 26)
    start = 0
    means = []
    for level in range(LEVELS):
        size = SIZE >> level
        part = bank.texels[:, start : start + size * size].reshape(-1, size, size, 3).astype(float)
        means.append(part.mean(axis=(1, 2)))
        start += size * size
        if level == 0:
            for kind in ("noise", "speckle", "strokes", "cells", "weave", "gradient"):
                for texture in part[bank.of_kind(kind)]:
                    seam = np.abs(texture[:, 0] - texture[:, -1]).mean()
                    inner = np.abs(np.diff(texture, axis=1)).mean(axis=(0, 2)).max()
                    assert seam <= 1.5 * inner + 1, kind
    assert start == bank.texels.shape[1]
    for coarser in means[1:]:
        np.testing.assert_allclose(coarser, means[0], atol=1)  # of 255: two roundings
