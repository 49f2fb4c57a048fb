"""Images matched with cameras, views chosen, arrays made and checked."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_cases import at, camera, captures, orbit
from hypothesis import given, settings
from hypothesis import strategies as st
from idesplat.runtime.errors import InputError
from idesplat.runtime.views import selection as view_choice
from idesplat.runtime.views.batch import build_view_batch, check_view_arrays, match_images_to_cameras
from idesplat.runtime.views.selection import PairScorer, guess_scene_depths, score_pairs, select_views
from views_in_a_row import extrinsics_in_a_row


def names(pairs):
    return [(str(path), camera.name) for path, camera in pairs]


# ---- matching


def test_match_goes_by_name_never_by_order():
    cameras = [camera("images/b.jpg"), camera("./images/unused.jpg"), camera("images\\a.jpg"), camera("train/r_0.5")]
    images = [Path("x/images/a.jpg"), Path("x/images/b.jpg"), Path("x/train/r_0.5.png")]
    expected = [("x/images/a.jpg", "images\\a.jpg"), ("x/images/b.jpg", "images/b.jpg")]
    assert names(match_images_to_cameras(images, cameras)) == [*expected, ("x/train/r_0.5.png", "train/r_0.5")]


def test_match_prefers_the_suffix_then_the_folders():
    cameras = [camera("left/1.png"), camera("left/1.jpg"), camera("right/1.jpg"), camera("2.png")]
    images = [Path("/data/right/1.jpg"), Path("/data/left/1.jpg"), Path("/data/images_4/2.jpg")]
    assert [name for _, name in names(match_images_to_cameras(images, cameras))] == [
        "right/1.jpg",
        "left/1.jpg",
        "2.png",
    ]


@pytest.mark.parametrize(
    ("images", "cameras", "expected"),
    [
        (["9.jpg"], ["1.jpg", "2.jpg"], r"none of 1 images \(9\.jpg\) .* 2 cameras \(1\.jpg, 2\.jpg\)"),
        ([], ["1.jpg"], "none of 0 images"),
        (["1.jpg", "9.jpg"], ["1", "2", "3", "4"], r"9\.jpg: none of 4 cameras names it \(1, 2, 3, \.\.\.\)"),
        (["1.jpg"], ["a/1.jpg", "b/1.jpg"], r"1\.jpg: 2 cameras match it equally \(a/1\.jpg, b/1\.jpg\)"),
        (["a/1.jpg", "a/1.png"], ["1"], r"a/1\.png and a/1\.jpg both match the camera of 1"),
    ],
)
def test_match_mistakes(images, cameras, expected):
    with pytest.raises(InputError, match=expected):
        match_images_to_cameras([Path(image) for image in images], [camera(name) for name in cameras])


# ---- choosing


def test_choose_takes_five_degrees_on_an_orbit():
    poses = orbit([0, 1, 40, 45.2, 90, 180, 181])
    assert select_views(at(poses), 2) == [2, 3]


def test_choose_spreads_over_a_dense_video():
    poses = orbit(np.arange(0, 90, 1.0))
    chosen = select_views(at(poses), 4)
    assert set(np.diff(chosen).tolist()) <= {5, 6}


def test_choose_prefers_a_step_aside_to_a_step_forward():
    poses = np.stack([np.eye(4)] * 4)
    poses[:, :3, 3] = [(0, 0, 0), (0, 0, 0.4), (0.3, 0, 0), (0, 0, 0.8)]
    cameras = [replace(camera, depth_range=(1.0, 16.0)) for camera in at(poses)]
    assert select_views(cameras, 2) == [0, 2]


def test_what_cameras_are_known_to_see_decides_the_baseline():
    poses = extrinsics_in_a_row(0, 0.1, 1, 10)
    for distance in (1, 10, 100):
        cameras = [replace(camera, depth_range=(0.5 * distance, 2.0 * distance)) for camera in at(poses)]
        first, second = select_views(cameras, 2)
        assert 0.08 < (poses[second, 0, 3] - poses[first, 0, 3]) / distance < 0.11


def test_compare_knows_overlap_and_parallax():
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3] = 40 / 70  # half of the image at a distance of 1, where 70 pixels are one unit
    poses[2, :3, :3] = np.diag([-1, 1, -1])  # looks back
    pairs = score_pairs(at(poses), np.ones(3))
    assert pairs.overlap[0, 1] == pairs.overlap[1, 0] == pytest.approx(0.5)
    assert 20 < pairs.parallax[0, 1] < np.degrees(2 * np.arctan(20 / 70))
    assert pairs.overlap[0, 2] == pairs.parallax[0, 2] == 0 and np.isinf(pairs.cost[0, 2])


def test_choose_does_not_depend_on_frame_or_unit():
    poses = orbit([0, 2, 5.5, 11, 13, 30])
    turned = np.diag([1.0, 1, 1, 1])
    turned[:3, :3] = cv2.Rodrigues(np.array([0.4, -1.2, 0.7]))[0]
    moved = turned @ poses
    moved[:, :3, 3] = 50 * moved[:, :3, 3] + (3, -8, 1)
    for count in range(2, 6):
        assert select_views(at(moved), count) == select_views(at(poses), count)


def test_choose_avoids_cameras_that_look_elsewhere():
    # Parallel cameras on a line; the second has the better baseline but is turned away from what the others see.
    poses = extrinsics_in_a_row(0, 0.26, 0.3, 1)
    assert select_views(at(poses), 2) == [0, 1]
    poses[1, :3, :3] = cv2.Rodrigues(np.array([0, 2.5, 0]))[0]
    assert select_views(at(poses), 2) == [0, 2]


def test_choose_does_not_repeat_a_place():
    poses = orbit([0, 5, 5, 0, 10])
    assert select_views(at(poses), 3) == [0, 1, 4]
    assert select_views(at(poses), 5) == [0, 1, 2, 3, 4]
    assert len(set(select_views(at(poses), 4))) == 4


def test_choose_mistakes():
    with pytest.raises(InputError, match="3 views asked for, expected 2 to 2"):
        select_views(at(orbit([0, 5])), 3)
    with pytest.raises(InputError, match="1 views asked for"):
        select_views(at(orbit([0, 5])), 1)
    with pytest.raises(InputError, match="no two cameras see the same from different places"):
        select_views(at([np.eye(4)] * 3), 2)


@given(
    st.lists(st.tuples(*[st.floats(-3, 3, allow_subnormal=False)] * 6), min_size=2, max_size=7),
    st.integers(2, 7),
)
@settings(max_examples=150)
def test_choose_gives_distinct_rising_indices_or_an_input_error(values, count):
    poses = np.stack([np.eye(4)] * len(values))
    for pose, value in zip(poses, values, strict=True):
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array(value[:3]))[0], value[3:]
    try:
        chosen = select_views(at(poses), count)
    except InputError:
        return
    assert len(chosen) == count and chosen == sorted(set(chosen)) and chosen[0] >= 0 and chosen[-1] < len(values)


def every_pair_scored(cameras, distances):
    """The cost of each two cameras, [cameras, cameras], by the definition: 6 x 6 points at the scene's distance."""
    steps = (np.arange(6) + 0.5) / 6
    total = len(cameras)
    overlap, parallax = np.eye(total), np.zeros((total, total))
    for i, first in enumerate(cameras):
        x, y = (side.ravel() for side in np.meshgrid(steps * first.width, steps * first.height))
        rays = np.stack([(x - first.K[0, 2]) / first.K[0, 0], (y - first.K[1, 2]) / first.K[1, 1], np.ones(36)], axis=1)
        points = distances[i] * rays @ first.extrinsics[:3, :3].T + first.extrinsics[:3, 3]
        for j, second in enumerate(cameras):
            local = (np.c_[points, np.ones(36)] @ np.linalg.inv(second.extrinsics).T)[:, :3]
            u, v, w = (local @ second.K.T).T
            inside = (w > 0) & (u >= 0) & (v >= 0) & (u <= second.width * w) & (v <= second.height * w)
            rays = [points - camera.extrinsics[:3, 3] for camera in (first, second)]
            a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
            angles = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
            overlap[i, j], parallax[i, j] = inside.mean(), angles[inside].mean() if inside.any() else 0
    both = (overlap > 0) & (overlap.T > 0)
    with np.errstate(divide="ignore"):
        cost = np.abs(np.log2((parallax + parallax.T) / 2 * both / 5))
    return np.round(cost - 2 * np.log2(np.maximum(np.minimum(overlap, overlap.T), 1e-3)), 6)


@pytest.mark.parametrize("name", captures(9))
def test_choosing_goes_by_the_best_of_all_pairs(name):
    cameras = at(captures(36)[name])
    distances = guess_scene_depths(cameras)
    cost = every_pair_scored(cameras, distances)
    centres = np.stack([camera.extrinsics[:3, 3] for camera in cameras])
    chosen = list(np.unravel_index(cost.argmin(), cost.shape))
    while len(chosen) < 4:
        rest = [index for index in range(len(cameras)) if index not in chosen]
        nearest = [chosen[int(np.linalg.norm(centres[chosen] - centres[index], axis=1).argmin())] for index in rest]
        chosen.append(rest[int(cost[rest, nearest].argmin())])
    assert select_views(cameras, 4) == sorted(chosen)
    assert select_views(cameras, 2) == sorted(chosen[:2])


@pytest.mark.parametrize("name", captures(9))
def test_large_captures_give_nearly_the_best_pair(name, monkeypatch):
    """Where not every pair is scored, the best that is found is nearly as good as the best there is."""
    cameras = at(captures(200, seed=1)[name])
    scorer = PairScorer(cameras, guess_scene_depths(cameras))
    best = scorer.score(*np.triu_indices(len(cameras), 1)).cost.min()
    monkeypatch.setattr(view_choice, "MAX_EXHAUSTIVE", 40)
    first, second = select_views(cameras, 2)
    found = scorer.score(np.array([first]), np.array([second])).cost[0]
    assert found <= best + 0.15  # a fifth of a parallax twice too large would be 0.26
    assert len(set(select_views(cameras, 6))) == 6


@pytest.mark.slow
def test_ten_thousand_cameras_take_little_memory():
    code = """
import resource, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from capture_cases import at, captures
from idesplat.runtime.views.selection import select_views
cameras = at(captures(10_000)["orbit"])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert len(select_views(cameras, 3)) == 3
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    pytest.importorskip("resource")
    done = subprocess.run(
        [sys.executable, "-c", code, Path(__file__).parents[2] / "support"], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 400 * (
        1024 if sys.platform != "darwin" else 1024**2
    )  # one square of numbers takes 800 MB


# ---- preparing


@pytest.fixture
def pairs(tmp_path):
    """Three images of one colour each, and their cameras on an orbit."""
    pairs = []
    for index, pose in enumerate(orbit([0, 5.1, 17])):
        path = tmp_path / f"{index}.png"
        cv2.imwrite(str(path), np.full((60, 80, 3), (30, 20, 10 * index), np.uint8))  # BGR
        distortion = (0.1, 0.0, 0.0, 0.0) if index == 1 else None
        pairs.append((path, camera(f"{index}.png", extrinsics=pose, distortion=distortion)))
    return pairs


def test_prepare_gives_what_the_network_takes(pairs):
    views = build_view_batch(pairs, None, 32, 32)
    assert views.names == ["0.png", "1.png", "2.png"]
    assert views.images.shape == (3, 3, 32, 32)
    for index, image in enumerate(views.images):
        np.testing.assert_allclose(
            image, np.broadcast_to(np.array([10 * index, 20, 30])[:, None, None] / 255, (3, 32, 32))
        )
    np.testing.assert_allclose(views.extrinsics, [camera.extrinsics for _, camera in pairs], rtol=1e-6)
    # 80 x 60 is scaled to 43 x 32, 5 columns are cut on the left
    scale_x, scale_y = 43 / 80, 32 / 60
    expected = [[70 * scale_x / 32, 0, (42 * scale_x - 5) / 32], [0, 72 * scale_y / 32, 29 * scale_y / 32], [0, 0, 1]]
    np.testing.assert_allclose(views.intrinsics, [expected] * 3, rtol=1e-6)
    assert [array.dtype for array in (views.images, views.intrinsics, views.extrinsics)] == ["f4", "f4", "f8"]
    assert views.selection_reason == ""
    assert [camera.distortion for camera in views.cameras] == [None] * 3
    check_view_arrays(views.images, views.extrinsics, views.intrinsics, 0.5, 100)


def test_prepare_reads_only_the_chosen_where_depths_are_known(pairs):
    pairs[2][0].unlink()
    pairs = [(path, replace(camera, depth_range=(2.0, 8.0))) for path, camera in pairs]
    views = build_view_batch(pairs, 2, 32, 32)
    assert views.names == ["0.png", "1.png"]
    assert (
        "parallax" in views.selection_reason
        and "a scene depth of 4 from the cameras' depth ranges" in views.selection_reason
    )


def test_prepare_scales_cameras_of_larger_images(pairs):
    doubled = [
        (path, replace(camera, width=160, height=120, K=np.diag([2, 2, 1]) @ camera.K)) for path, camera in pairs
    ]
    expected = build_view_batch(pairs, None, 32, 32)
    views = build_view_batch(doubled, None, 32, 32)
    np.testing.assert_allclose(views.intrinsics, expected.intrinsics)
    assert (views.cameras[1].width, views.cameras[1].height) == (80, 60)


def test_prepare_mistakes(pairs):
    (path0, camera0), (path1, camera1), _ = pairs
    with pytest.raises(InputError, match="1 image with a camera, expected at least 2"):
        build_view_batch(pairs[:1], None, 32, 32)
    turned = replace(camera1, width=60, height=80, K=np.array([[70.0, 0, 30], [0, 70, 40], [0, 0, 1]]))
    with pytest.raises(InputError, match=r"1\.png: the image has 80 x 60 pixels, its camera 60 x 80"):
        build_view_batch([(path0, camera0), (path1, turned)], None, 32, 32)
    twin = camera0.extrinsics + 1e-6 * np.eye(4, k=3)
    with pytest.raises(InputError, match=r"0\.png and 1\.png have the same pose"):
        build_view_batch([(path0, camera0), (path1, replace(camera1, extrinsics=twin)), pairs[2]], None, 32, 32)
    same_place = camera1.extrinsics.copy()
    same_place[:3, 3] = camera0.extrinsics[:3, 3]
    with pytest.raises(InputError, match=r"0\.png and 1\.png are at the same position"):
        build_view_batch([(path0, camera0), (path1, replace(camera1, extrinsics=same_place))], None, 32, 32)


# ---- checking arrays


@pytest.fixture
def arrays():
    poses = orbit([0, 5]).astype(np.float32)
    normalised = np.array([[0.9, 0, 0.5], [0, 1.1, 0.45], [0, 0, 1]], np.float32)
    images = np.random.default_rng(0).random((2, 3, 8, 16), dtype=np.float32)
    return {"images": images, "extrinsics": poses, "intrinsics": np.stack([normalised] * 2), "near": 0.5, "far": 100.0}


def test_good_arrays_pass(arrays):
    check_view_arrays(**arrays)
    check_view_arrays(**{**arrays, "near": np.array([0.5, 0.7]), "far": np.array([100, 50])})
    check_view_arrays(**{**arrays, "images": arrays["images"].tolist()})


def put(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("images", lambda a: a[0], r"images: shape \(3, 8, 16\), expected \[views, 3, height, width\]"),
        ("images", lambda a: a.transpose(0, 2, 3, 1), "images: shape"),
        ("images", lambda a: (a * 255).astype(np.uint8), "images: type uint8, expected float32"),
        ("images", lambda a: a * 255, "images: values from .*divide 8-bit pixels by 255"),
        ("images", lambda a: a - 0.5, "images: values from"),
        ("images", lambda a: put(a, (1, 2, 3, 4), np.nan), r"images\[1\]: holds NaN"),
        ("images", lambda a: a[:, :, :0], "images: shape"),
        ("images", lambda a: [[1, 2], [3]], "images: not an array"),
        ("images", lambda a: None, "images: type object"),
        ("images", lambda a: a[:1], r"extrinsics: shape \(2, 4, 4\), .*1 views being given"),
        ("extrinsics", lambda a: a[:, :3], r"extrinsics: shape \(2, 3, 4\), expected \[views, 4, 4\]"),
        ("extrinsics", lambda a: put(a, (1, 0, 3), np.inf), r"extrinsics\[1\]: holds NaN or infinity"),
        ("extrinsics", lambda a: put(a, (1, slice(3), slice(3)), 2 * np.eye(3)), r"extrinsics\[1\]: .*scaled"),
        ("extrinsics", lambda a: a @ np.diag([1, -1, 1, 1.0]), r"extrinsics\[0\]: .*mirrored"),
        ("extrinsics", lambda a: put(a, 1, a[0]), "view 0 and view 1 are at the same position"),
        ("intrinsics", lambda a: a * np.array([[16], [8], [1]]), r"intrinsics\[0\], normalised .*principal point"),
        ("intrinsics", lambda a: put(a, (1, 0, 0), -1), r"intrinsics\[1\], .*focal lengths"),
        ("intrinsics", lambda a: put(a, (1, 0, 1), 0.1), r"intrinsics\[1\], .*no skew"),
        ("near", lambda a: 0, "near: 0, expected a distance above 0"),
        ("near", lambda a: np.nan, "near: holds NaN"),
        ("near", lambda a: "1", "near: .*expected a number"),
        ("near", lambda a: [1, 2, 3], r"near: .*shape \(3,\)"),
        ("far", lambda a: 0.5, "far: 0.5, expected beyond near, which is 0.5"),
        ("far", lambda a: [100, 0.1], "far: 0.1, expected beyond near"),
    ],
)
def test_bad_arrays_are_named(arrays, name, change, expected):
    with pytest.raises(InputError, match=expected) as caught:
        check_view_arrays(**{**arrays, name: change(arrays[name])})
    assert "\n" not in str(caught.value)


def test_one_view_is_too_few(arrays):
    first = {name: value[:1] for name, value in arrays.items() if name not in ("near", "far")}
    with pytest.raises(InputError, match="1 view given, expected at least 2"):
        check_view_arrays(**first, near=0.5, far=100)


def test_two_of_three_cameras_coincide(arrays):
    poses = orbit([0, 5, 0])
    three = {name: np.concatenate([arrays[name], arrays[name][:1]]) for name in ("images", "intrinsics")}
    with pytest.raises(InputError, match="view 0 and view 2 have the same pose"):
        check_view_arrays(**three, extrinsics=poses, near=0.5, far=100)


def test_two_of_three_cameras_may_share_a_place(arrays):
    poses = orbit([0, 5, 0])
    poses[2, :3, :3] = poses[1, :3, :3]
    three = {name: np.concatenate([arrays[name], arrays[name][:1]]) for name in ("images", "intrinsics")}
    check_view_arrays(**three, extrinsics=poses, near=0.5, far=100)
