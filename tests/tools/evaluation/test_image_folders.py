"""The split of a folder of images into context and held-out views, and masks of valid pixels."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import read_cameras
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.finding import find_images
from idesplat.runtime.views.batch import ViewBatch, build_view_batch, match_images_to_cameras
from idesplat.runtime.views.depth_range import DepthRange
from idesplat.tools.evaluation.image_folders import Frame, context_for, load_case, split_frames
from idesplat.tools.synthetic.views import look_at

SIZE = HEIGHT, WIDTH = 64, 96  # of images 96 x 128: scaled to 72 x 96, four rows cut above and below


def find_range(views: ViewBatch) -> DepthRange:
    """A range that tells from how many views it was estimated."""
    return DepthRange(1, 10 * len(views.names), "the test")


def frames_of(folder: Path) -> list[Frame]:
    return match_images_to_cameras(find_images([folder / "images"]), read_cameras(folder / "transforms.json"))


def on_a_line(count: int) -> list[Frame]:
    """Frames one unit apart with the same viewing direction."""
    K = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    frames = []
    for index in range(count):
        pose = look_at(np.array([float(index), 0, 0]), np.array([float(index), 0, 9]))
        frames.append((Path(f"images/{index:04}.jpg"), Camera(f"images/{index:04}.jpg", 128, 96, K, pose)))
    return frames


def test_named_frames() -> None:
    frames = on_a_line(9)
    assert split_frames(frames, ["0006", "0008.jpg"], ["0007"], 2, 8) == [([6, 8], [7])]
    assert split_frames(frames, ["0008", "0000", "0006"], ["0007", "0001"], 2, 8) == [([8, 0, 6], [7, 1])]


def test_frames_held_out_by_number() -> None:
    """As in LLFF's split: frames 0, 8, 16 and on."""
    frames = on_a_line(20)
    assert split_frames(frames, [], [], 2, 8) == [([1, 2], [0]), ([7, 9], [8]), ([15, 17], [16])]
    assert split_frames(frames, [], [], 2, 2)[:2] == [([1, 3], [0, 2]), ([3, 5], [4])]
    assert split_frames(on_a_line(5), [], [], 2, 8) == [([1, 2], [0])]
    assert split_frames(frames, [], ["0004", "0005"], 2, 8) == [([3, 6], [4, 5])]  # the held out are no context


def test_context_lies_around_the_target() -> None:
    line = np.stack([camera.extrinsics for _, camera in on_a_line(9)])
    assert context_for(line, 4, [0, 1, 2, 3, 5, 6], 2) == [3, 5]
    assert context_for(line, 4, [2, 3, 8], 2) == [3, 8]  # the other side goes before nearness
    assert context_for(line, 4, [2, 3, 8], 3) == [2, 3, 8]
    assert context_for(line, 4, [0, 1, 2, 3, 5, 6], 4) == [2, 3, 5, 6]
    assert context_for(line, 0, [2, 3, 8], 2) == [2, 3]  # nothing is on the other side
    turned = line.copy()
    turned[5, :3, :3] = np.diag([-1.0, 1, -1]) @ line[5, :3, :3]  # looks back
    assert context_for(turned, 4, [2, 3, 5, 6], 2) == [3, 6]


@pytest.mark.parametrize(
    ("context", "targets", "views", "expected"),
    [
        (["0006", "0099"], ["0007"], 2, "--context 0099: the name of none of 9 images"),
        (["0006", "0008"], ["7"], 2, "--hold-out 7: the name of none"),
        (["0006", "0008"], ["0006"], 2, "0006.jpg is named twice"),
        (["0006", "0006"], ["0007"], 2, "0006.jpg is named twice"),
        (["0006", "0008"], [], 2, "--context without --hold-out"),
        (["0006"], ["0007"], 2, "expected at least 2"),
        ([], ["0007"], 9, "too few are left for a context of 9"),
        ([], [], 9, "too few are left for a context of 9"),
        ([], [], 1, "--views 1: expected at least 2"),
    ],
)
def test_refuses_splits_that_cannot_be_made(context: list[str], targets: list[str], views: int, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        split_frames(on_a_line(9), context, targets, views, 8)


def test_images_are_prepared_as_for_inference(scene: Path) -> None:
    frames = frames_of(scene)
    case = load_case(frames, [0, 4], [2, 1], SIZE, find_range)
    assert (case.name, case.context.names, case.targets.names) == (
        "000+004",
        ["000.png", "004.png"],
        ["002.png", "001.png"],
    )
    assert (case.near, case.far) == (1, 20)
    views = build_view_batch([frames[index] for index in (0, 4, 2, 1)], None, HEIGHT, WIDTH)
    np.testing.assert_array_equal(np.concatenate([case.context.images, case.targets.images]), views.images)
    np.testing.assert_array_equal(case.targets.extrinsics, views.extrinsics[2:])
    assert case.context.valid.all() and case.targets.valid.all()
    K = views.cameras[2].K
    np.testing.assert_allclose(case.targets.K(0)[0, 0], 0.75 * K[0, 0], rtol=1e-6)
    np.testing.assert_allclose(case.targets.K(0)[1, 2], 64 / 96 * K[1, 2], rtol=1e-6)


def test_a_case_of_many_images_has_a_short_name_of_its_own(scene: Path, tmp_path: Path) -> None:
    frames = []
    for number, (path, camera) in enumerate(frames_of(scene)):
        frames.append((tmp_path / f"{number}{'é' * 60}.png", camera))
        shutil.copy(path, frames[-1][0])
    first, second = (load_case(frames, [0, other, 4], [2], SIZE, find_range).name for other in (1, 3))
    assert len(first.encode()) <= 100 and first != second
    assert first.startswith("0é") and "+4é" in first and "-3-" in first


def test_black_borders_are_invalid(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "scene")
    path = tmp_path / "scene" / "images" / "002.png"
    image = cv2.imread(str(path))
    image[:, :16] = 3  # as an undistorted image has it
    image[50:56, 60:70] = 0  # something black in the middle
    cv2.imwrite(str(path), image)
    case = load_case(frames_of(tmp_path / "scene"), [0, 4], [2], SIZE, find_range)
    (valid,) = case.targets.valid
    # sixteen columns and a block of JPEG are eighteen columns here, beside which two are left out
    assert not valid[:, :18].any() and valid[:, 22:].all()
    assert case.context.valid.all()


def test_pixels_outside_the_lens_image_are_invalid(scene: Path) -> None:
    frames = frames_of(scene)
    bent = [(path, replace(camera, distortion=(0.3, 0.0, 0.0, 0.0))) for path, camera in frames]
    (valid,) = load_case(bent, [0, 4], [2], SIZE, find_range).targets.valid
    assert valid[16:48, 24:72].all() and not valid[0, 0] and 0.5 < valid.mean() < 0.99


@pytest.mark.parametrize(
    ("size", "scales", "top"),
    [((64, 96), (64 / 96, 0.75), 0), ((64, 128), (1, 1), 16)],
    ids=["nearly the same shape: stretched", "another shape: cropped"],
)
@pytest.mark.parametrize("along", ["rows", "columns"])
def test_true_depth_is_sampled_at_the_networks_pixels(
    along: str, size: tuple[int, int], scales: tuple[float, float], top: int, scene: Path, tmp_path: Path
) -> None:
    """Depth that is the pixel coordinate tells where it was sampled: within half a pixel."""
    y, x = np.meshgrid(np.arange(96) + 0.5, np.arange(128) + 0.5, indexing="ij")
    for name in ("000", "004"):
        np.savez(tmp_path / f"{name}.npz", depth=y if along == "rows" else x)
    case = load_case(frames_of(scene), [0, 4], [2], size, find_range, tmp_path)
    assert case.depth is not None and case.depth.shape == (2, *size)
    rows, columns = (np.arange(size[0]) + 0.5 + top) / scales[0], (np.arange(size[1]) + 0.5) / scales[1]
    expected = rows[:, None] if along == "rows" else columns[None]
    assert np.abs(case.depth - expected).max() <= 0.5 + 1e-6


def test_refuses_depth_that_does_not_fit(scene: Path, tmp_path: Path) -> None:
    frames = frames_of(scene)
    with pytest.raises(InputError, match=r"000\.npz: no readable depth"):
        load_case(frames, [0, 4], [2], SIZE, find_range, tmp_path)
    np.savez(tmp_path / "000.npz", depth=np.ones((9, 9)))
    with pytest.raises(InputError, match=r"depth of shape \(9, 9\), expected \(96, 128\)"):
        load_case(frames, [0, 4], [2], SIZE, find_range, tmp_path)
    bent = [(path, replace(camera, distortion=(0.1, 0.0, 0.0, 0.0))) for path, camera in frames]
    with pytest.raises(InputError, match="lens distortion"):
        load_case(bent, [0, 4], [2], SIZE, find_range, scene / "depth")


def test_refuses_a_black_image(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "scene")
    cv2.imwrite(str(tmp_path / "scene" / "images" / "002.png"), np.zeros((96, 128, 3), np.uint8))
    with pytest.raises(InputError, match=r"002\.png: is black"):
        load_case(frames_of(tmp_path / "scene"), [0, 4], [2], SIZE, find_range)


def test_refuses_two_frames_at_one_pose(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "scene")
    cameras = json.loads((scene / "transforms.json").read_text())
    cameras["frames"][2]["transform_matrix"] = cameras["frames"][0]["transform_matrix"]
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match="same pose"):
        load_case(frames_of(tmp_path / "scene"), [0, 4], [2], SIZE, find_range)
