"""Near, far and the distance of a scene, held against the true depth of a synthetic room."""

from dataclasses import replace

import numpy as np
import pytest
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.geometry.depth_bounds import depth_bounds
from idesplat.runtime.views.batch import build_view_batch
from idesplat.runtime.views.depth_range import estimate_depth_range, scene_depths
from idesplat.runtime.views.loader import ViewLoader

TRAINED = (1.0, 100.0)


@pytest.fixture(scope="module")
def room(scene):
    """Images with cameras, and the true depth of each."""
    pairs = [(scene / camera.name, camera) for camera in read_cameras(scene / "transforms.json")]
    depth = [np.load(scene / "depth" / f"{path.stem}.npz")["depth"] for path, _ in pairs]
    return pairs, np.stack(depth)


def ranged(pairs, **given):
    views = build_view_batch(pairs, None, 96, 128)
    return estimate_depth_range(
        views.images,
        views.extrinsics,
        views.intrinsics,
        views.cameras,
        TRAINED,
        matcher=views.matcher,
        **given,
    )


def test_matched_points_bound_the_true_depth(room):
    pairs, depth = room
    found = ranged(pairs[::2])
    assert "points matched" in found.source
    assert 0.3 * depth.min() < found.near < np.percentile(depth, 2)
    assert np.percentile(depth, 98) < found.far < 4 * depth.max()


def test_the_range_has_the_cameras_unit(room):
    pairs, _ = room
    first = ranged(pairs[:2])
    scaled = []
    for path, camera in pairs[:2]:
        extrinsics = camera.extrinsics.copy()
        extrinsics[:3, 3] *= 1000
        scaled.append((path, replace(camera, extrinsics=extrinsics)))
    other = ranged(scaled)
    assert (other.near, other.far) == (pytest.approx(1000 * first.near), pytest.approx(1000 * first.far))


def test_what_is_known_goes_first_and_what_is_given_stays(room):
    pairs, _ = room
    known = [(path, replace(camera, depth_range=(2.0 + i, 9.0 + i))) for i, (path, camera) in enumerate(pairs[:2])]
    assert (ranged(known).near, ranged(known).far) == (2.0, 10.0)
    assert (ranged(known, near=0.5).near, ranged(known, near=0.5).far) == (0.5, 10.0)
    both = ranged(known, near=0.5, far=7.0)
    assert (both.near, both.far, both.source) == (0.5, 7.0, "given")
    with pytest.raises(InputError, match=r"near 20 and far 10 .*give --near and --far"):
        ranged(known, near=20.0)


def test_without_matches_the_baseline_decides(room):
    pairs, _ = room
    blank = [(np.full((camera.height, camera.width, 3), 128, np.uint8), camera) for _, camera in pairs[:2]]
    found = ranged(blank)
    baseline = np.linalg.norm(pairs[0][1].extrinsics[:3, 3] - pairs[1][1].extrinsics[:3, 3])
    assert (found.near, found.far) == (pytest.approx(baseline), pytest.approx(100 * baseline))
    assert found.source == "the baseline"


def test_the_scene_is_as_far_as_it_is(room):
    pairs, depth = room
    distances, source = scene_depths([camera for _, camera in pairs], ViewLoader(pairs, 64, 96).feature_image)
    assert "points matched" in source
    assert 0.6 < distances[0] / np.median(depth) < 1.6


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0])
def test_range_of_depths_leaves_out_what_is_no_depth(bad):
    depths = np.linspace(2, 10, 101)
    near, far = depth_bounds(np.append(depths, [bad] * 50))
    assert (near, far) == depth_bounds(depths)
    assert 0 < near < 2 and far > 10
    assert depth_bounds(np.full(50, bad)) is None
