"""Cameras of synthetic scenes: those of training follow real captures, and those of held-out scenes never change."""

from dataclasses import replace

import numpy as np
import pytest
from grey_scenes import scene_of
from idesplat.tools.evaluation.captures import camera_statistics as statistics
from idesplat.tools.evaluation.captures.camera_statistics import quantiles_of, sample_statistics
from idesplat.tools.synthetic.placement import (
    MAX_ARC,
    TRAINING_PLACEMENT,
    CameraPlacement,
    _sample_neighbour_poses,
    arc,
)
from idesplat.tools.synthetic.raycast import BOX, ELLIPSOID
from idesplat.tools.synthetic.sampler import HELD_OUT_SEEDS, VALIDATION_SEEDS, Sample, generate_sample
from idesplat.tools.synthetic.views import PROBE, look_at, probe

TELE = np.array([[3.0, 0, 0.5], [0, 3.0, 0.5], [0, 0, 1]])  # normalised intrinsics: 19 degrees

# Positions of three context views and two targets, in scene units, and the focal lengths and the principal point of all
# views. Computed at commit 31e3e69, before training scenes had cameras of their own.
BEFORE = {
    VALIDATION_SEEDS[0]: (
        [
            [0.327555, -0.82955277, -2.2727497],
            [0.15262415, -1.0095115, -2.2368953],
            [0.0616413, -1.0837379, -2.2632756],
            [0.03027085, -1.1250668, -2.2263339],
            [0.1669278, -0.9263098, -2.2429254],
        ],
        [1.0697851, 1.0743573, 0.50914365, 0.50027096],
    ),
    HELD_OUT_SEEDS[0]: (
        [
            [-2.2936125, -2.2648556, -0.8399315],
            [-2.4391868, -2.3280315, -0.86937946],
            [-2.6052358, -2.3255234, -0.8941755],
            [-2.6341758, -2.3611722, -0.91229755],
            [-2.4894207, -2.3041458, -0.88541037],
        ],
        [0.9914236, 0.97657096, 0.4857763, 0.5206749],
    ),
}
# The optical axis of the last view, likewise.
LAST_AXIS = {
    VALIDATION_SEEDS[0]: [0.008166971, -0.4636585, 0.8859763],
    HELD_OUT_SEEDS[0]: [0.8483654, 0.41465783, 0.32914287],
}
# The middle 80 % of the validation captures' triples, as camera_statistics prints them.
CAPTURED = {
    statistics.BASELINE: (0.214, 0.345),
    statistics.AXES: (3.32, 20.3),
    statistics.MIDDLE: (12.1, 19.8),
    statistics.CONVERGENCE: (0.216, 1.09),
    statistics.ROLL: (1.30, 17.3),
    statistics.FIELD_OF_VIEW: (35.7, 53.5),
}
MEDIANS = {statistics.BASELINE: 0.256, statistics.AXES: 14.7, statistics.MIDDLE: 14.6, statistics.FIELD_OF_VIEW: 50.2}
ORBITS = replace(TRAINING_PLACEMENT, orbits=1.0)
RADIUS = 2.5


def sample_of(seed: int, context: int, targets: int = 2) -> Sample:
    """A sample whose images are black, which takes less time."""
    return generate_sample(seed, context, targets, 32, 32, samples=0)


def orbit(
    context: int, targets: int, seed: int = 0, placement: CameraPlacement = ORBITS
) -> tuple[np.ndarray, np.ndarray]:
    """Poses on an arc, and the point in the middle of the first view, which sees a wall at RADIUS."""
    first = look_at(np.array([1.0, -1.5, -2.0]), np.array([0.4, -0.5, 1.0]), roll=0.1)
    seen = np.full((PROBE, PROBE), RADIUS)
    poses = _sample_neighbour_poses(np.random.default_rng(seed), first, seen, context, targets, placement)
    return poses, first[:3, 3] + RADIUS * first[:3, 2]


@pytest.mark.parametrize("seed", BEFORE)
def test_cameras_of_reported_scenes_are_those_of_earlier_versions(seed: int) -> None:
    sample = sample_of(seed, 3)
    positions, (fx, fy, cx, cy) = BEFORE[seed]
    np.testing.assert_allclose(sample.extrinsics[:, :3, 3], positions, rtol=1e-6)
    np.testing.assert_allclose(sample.extrinsics[-1, :3, 2], LAST_AXIS[seed], rtol=1e-6)
    expected = np.tile(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (5, 1, 1))
    np.testing.assert_allclose(sample.intrinsics, expected, rtol=1e-6)


def test_positions_on_an_arc() -> None:
    """A quarter of a circle of radius 2 from the front to the right, and one straight up from there."""
    eye, focus, right = np.array([0.0, 0, -2]), np.zeros(3), np.array([3.0, 0, 0])
    found = arc(eye, focus, right, np.array([0, np.pi / 2, 0]), np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(found[:2], [[0, 0, -2], [2, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(np.abs(found[2]), [0, 2, 0], atol=1e-12)
    towards = arc(eye, focus, np.array([3.0, 0, 5]), np.array([0.3]), np.zeros(1))
    np.testing.assert_allclose(towards, [[2 * np.sin(0.3), 0, -2 * np.cos(0.3)]], atol=1e-12)


@pytest.mark.parametrize("context", [2, 3, 4, 5, 6])
def test_cameras_of_an_orbit_are_equally_far_from_the_point_in_their_middle(context: int) -> None:
    for seed in range(20):
        poses, focus = orbit(context, 3, seed)
        towards = focus - poses[:, :3, 3]
        np.testing.assert_allclose(np.linalg.norm(towards, axis=1), RADIUS, rtol=1e-9)
        np.testing.assert_allclose(poses[:, :3, 2], towards / RADIUS, atol=1e-9)


@pytest.mark.parametrize(("context", "baseline", "angle"), [(2, 0.25, 0.25), (6, 0.25, 0.25), (6, 0.5, MAX_ARC / 5)])
def test_neighbours_on_an_orbit_are_a_baseline_over_the_radius_apart(
    context: int, baseline: float, angle: float
) -> None:
    """The mean over seeds of the angle from the first view to the last in radians, by step; long arcs are bounded."""
    placement = replace(ORBITS, baseline=(baseline, baseline))
    poses = np.stack([orbit(context, 0, seed, placement)[0] for seed in range(100)])
    total = np.arccos((poses[:, 0, :3, 2] * poses[:, -1, :3, 2]).sum(axis=1))
    assert total.mean() / (context - 1) == pytest.approx(angle, rel=0.05)


def test_targets_of_an_orbit_are_around_its_context() -> None:
    for seed in range(20):
        poses, focus = orbit(4, 8, seed)
        first, last, targets = poses[0, :3, 3], poses[3, :3, 3], poses[4:, :3, 3]
        along = (targets - first) @ (last - first) / np.sum((last - first) ** 2)
        assert (along > -0.5).all() and (along < 1.5).all()
        assert (np.linalg.norm(targets - focus, axis=1) == pytest.approx(RADIUS)) and np.ptp(along) > 0.2


def is_orbit(sample: Sample) -> bool:
    """Whether all optical axes meet in one point at the same distance from all cameras."""
    positions, axes = sample.extrinsics[:, :3, 3].astype(float), sample.extrinsics[:, :3, 2].astype(float)
    # |c + t z - c0 - t z0| is least at one t, the distance that all cameras would have from the point.
    offset, turn = positions[1:] - positions[0], axes[1:] - axes[0]
    if not turn.any():  # parallel: the row of cameras of a scene in which all placements are blocked
        return False
    distance = -(offset * turn).sum() / (turn * turn).sum()
    missed = np.linalg.norm(offset + distance * turn, axis=1)
    return bool(missed.max() < 1e-3 * np.linalg.norm(offset, axis=1).max())


def test_the_placement_s_share_of_the_training_samples_are_orbits() -> None:
    for context in (2, 6):
        share = np.mean([is_orbit(sample_of(seed, context)) for seed in range(60)])
        assert 0.5 < share < 0.9
    assert not any(is_orbit(sample_of(seed, 2)) for seed in HELD_OUT_SEEDS[:20])


def seen_share(sample: Sample, view: int) -> float:
    """The share of the first view's points that project into another view."""
    height, width = sample.depth.shape[1:]
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(sample.intrinsics[0]).T
    points = (points * sample.depth[0][..., None]).reshape(-1, 3)
    relative = np.linalg.inv(sample.extrinsics[view].astype(float)) @ sample.extrinsics[0]
    projected = (points @ relative[:3, :3].T + relative[:3, 3]) @ sample.intrinsics[view].T
    inside = (projected[:, 2] > 0) & (np.abs(projected[:, :2] / projected[:, 2:] - 0.5) < 0.5).all(axis=1)
    return float(inside.mean())


def test_six_context_views_and_their_targets_see_what_the_first_sees() -> None:
    """0.6 is asked of a coarse depth map; a few scenes have no such placement, and take the best that was found."""
    least = [min(seen_share(sample, view) for view in range(1, 8)) for sample in (sample_of(s, 6) for s in range(40))]
    assert np.quantile(least, 0.1) > 0.55


def test_pairs_of_training_views_cover_those_of_captures() -> None:
    """The middle 80 % of the captures lies within that of 250 samples, up to their noise; medians are half at least."""
    found = quantiles_of([pair for seed in range(250) for pair in sample_statistics(sample_of(seed, 2))])
    for name, (low, high) in CAPTURED.items():
        assert found[name][0] < 1.25 * low and found[name][2] > 0.85 * high, name
    for name, median in MEDIANS.items():
        assert 0.5 * median < found[name][1] < 1.3 * median, name


def test_level_cameras_do_not_pass_above_what_they_look_at() -> None:
    axes = np.concatenate([sample_of(seed, 3).extrinsics[:, :3, 2] for seed in range(40)])
    assert np.abs(axes[:, 1]).max() <= TRAINING_PLACEMENT.steepest + 1e-6


@pytest.mark.parametrize(("shape", "inside", "outside"), [(BOX, 9, 11), (ELLIPSOID, 5, 6)])
def test_a_camera_outside_the_enclosing_solid_sees_nothing(shape: int, inside: float, outside: float) -> None:
    """It looks inwards through a wall, so that every ray hits something. 5 and 6 on each axis are 8.7 and 10.4 away."""
    scene = scene_of()._replace(shapes=np.array([shape]))
    eyes = [np.array([0.0, 0.0, side]) if shape == BOX else np.full(3, float(side)) for side in (inside, outside)]
    seen = [probe(scene, look_at(eye, np.array([0.0, 0.0, 0.1])), TELE) for eye in eyes]
    assert seen[0].min() > 10
    assert (seen[1] == 0).all()
