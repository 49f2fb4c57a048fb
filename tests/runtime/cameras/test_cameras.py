"""Camera files: every format gives the same OpenCV cameras, and every mistake one clear line."""

import copy
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from idesplat.runtime.cameras.camera import Camera, named_from, resize_camera
from idesplat.runtime.cameras.io import CameraFormat, read_cameras, write_cameras
from idesplat.runtime.errors import InputError

DISTORTION = (0.058, -0.081, -0.001, 0.0002)


def pose(angles, position):
    """A camera-to-world pose from Euler angles, by OpenCV's Rodrigues vectors."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(angles, dtype=float))[0]
    matrix[:3, 3] = position
    return matrix


def test_a_linked_image_keeps_the_name_of_its_link(tmp_path: Path) -> None:
    """As datasets of links have them: images are matched to cameras by that name."""
    for folder in ("store", "photos"):
        (tmp_path / folder).mkdir()
    (tmp_path / "store" / "9f3a.jpg").write_bytes(b"")
    (tmp_path / "photos" / "a.jpg").symlink_to("../store/9f3a.jpg")
    camera = Camera(str(tmp_path / "photos" / "a.jpg"), 8, 8, np.diag([8.0, 8, 1]), np.eye(4))
    assert named_from(tmp_path, [camera])[0].name == "photos/a.jpg"


@pytest.fixture
def cameras():
    """Three cameras with principal points off centre; the second has no distortion."""
    return [
        Camera(
            f"images/{index:04}.jpg",
            640 + index,
            480 - index,
            np.array([[510.25 + index, 0, 301.5], [0, 498.75, 251.125 + index], [0, 0, 1]]),
            pose((0.3 * index, -0.2, 0.1), (index, -2.5, 1 / 3)),
            None if index == 1 else DISTORTION,
        )
        for index in range(3)
    ]


def as_transforms(cameras):
    """The cameras as nerfstudio writes them: OpenGL axes, each frame with its own intrinsics."""
    frames = []
    for camera in cameras:
        right, down, forward, position = camera.extrinsics.T
        frame = {
            "file_path": camera.name,
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.K[0, 0],
            "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
            "transform_matrix": np.stack([right, -down, -forward, position], axis=1).tolist(),
        }
        if camera.distortion is not None:
            frame.update(zip(("k1", "k2", "p1", "p2"), camera.distortion, strict=True))
        frames.append(frame)
    return {"camera_model": "OPENCV", "frames": frames}


def dump(path, document):
    path.write_text(json.dumps(document))
    return path


def assert_same(read, expected, tolerance):
    assert [camera.name for camera in read] == [camera.name for camera in expected]
    for ours, theirs in zip(read, expected, strict=True):
        assert (ours.width, ours.height, ours.distortion) == (theirs.width, theirs.height, theirs.distortion)
        np.testing.assert_allclose(ours.K, theirs.K, rtol=0, atol=tolerance)
        np.testing.assert_allclose(ours.extrinsics, theirs.extrinsics, rtol=0, atol=tolerance)


def test_own_format_round_trip_is_exact(tmp_path, cameras):
    write_cameras(tmp_path / "cameras.json", cameras)
    assert_same(read_cameras(tmp_path / "cameras.json"), cameras, 0)


def test_own_format_from_its_documentation(tmp_path):
    document = {
        "format": "idesplat-cameras",
        "version": 1,
        "cameras": [
            {
                "image": "a.png",
                "width": 100,
                "height": 50,
                "fx": 80,
                "fy": 81,
                "cx": 49,
                "cy": 26,
                "extrinsics": [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]],
            }
        ],
    }
    (camera,) = read_cameras(dump(tmp_path / "anything.txt", document))
    assert (camera.name, camera.width, camera.height, camera.distortion) == ("a.png", 100, 50, None)
    assert camera.K.tolist() == [[80, 0, 49], [0, 81, 26], [0, 0, 1]]
    assert camera.extrinsics[:3, 3].tolist() == [5, 6, 7]


def test_transforms_gives_the_same_cameras(tmp_path, cameras):
    assert_same(read_cameras(dump(tmp_path / "transforms.json", as_transforms(cameras))), cameras, 1e-6)


def test_transforms_with_shared_intrinsics(tmp_path, cameras):
    document = as_transforms([cameras[0], cameras[0]])
    for frame in document["frames"]:
        for field in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
            document[field] = float(frame.pop(field))
    document["frames"][1]["file_path"] = "images/other"
    first, second = read_cameras(dump(tmp_path / "transforms.json", document))
    assert_same([first], [cameras[0]], 1e-6)
    assert second.name == "images/other"
    np.testing.assert_allclose(second.K, cameras[0].K, rtol=0, atol=1e-6)


def test_opengl_looks_along_its_negative_z(tmp_path):
    # An OpenGL camera without rotation, 3 before the origin: the origin lies in the middle, +y above.
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    document = {"w": 100, "h": 80, "fl_x": 90, "frames": [{"file_path": "a", "transform_matrix": matrix}]}
    (camera,) = read_cameras(dump(tmp_path / "t.json", document))
    x, y, z = (camera.K @ np.linalg.inv(camera.extrinsics)[:3] @ np.array([0, 1, 0, 1])).tolist()
    assert z == pytest.approx(3)
    assert (x / z, y / z) == (pytest.approx(50), pytest.approx(40 - 90 / 3))


def test_camera_angle_and_missing_size_come_from_the_image(tmp_path):
    # As in Blender's synthetic scenes: a field of view, no size, no suffix.
    (tmp_path / "train").mkdir()
    cv2.imwrite(str(tmp_path / "train" / "r_0.png"), np.zeros((60, 80, 3), np.uint8))
    frames = [{"file_path": f"./train/r_{i}", "transform_matrix": pose((0, 0, 0), (i, 0, 0)).tolist()} for i in (0, 1)]
    document = {"camera_angle_x": 0.7, "frames": frames}
    first, second = read_cameras(dump(tmp_path / "transforms_train.json", document))
    focal = 40 / math.tan(0.35)
    for camera in (first, second):
        assert (camera.width, camera.height) == (80, 60)
        np.testing.assert_allclose(camera.K, [[focal, 0, 40], [0, focal, 30], [0, 0, 1]], rtol=1e-12)
    document["camera_angle_y"] = 0.5
    assert read_cameras(dump(tmp_path / "t.json", document))[0].K[1, 1] == pytest.approx(30 / math.tan(0.25))
    (tmp_path / "train" / "r_0.png").unlink()
    with pytest.raises(InputError, match=r"frames\[0\] .*w and h are missing"):
        read_cameras(tmp_path / "transforms_train.json")


def test_frames_with_their_own_intrinsics_have_their_own_size(tmp_path):
    frames = []
    for index, width in enumerate((80, 160)):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((60, width, 3), np.uint8))
        matrix = pose((0, 0, 0), (index, 0, 0)).tolist()
        frames.append({"file_path": f"{index}.png", "fl_x": 70, "transform_matrix": matrix})
    read = read_cameras(dump(tmp_path / "t.json", {"frames": frames}))
    assert [camera.width for camera in read] == [80, 160]


def test_rounded_rotation_becomes_orthonormal(tmp_path, cameras):
    document = as_transforms(cameras)
    rounded = np.round(np.array(document["frames"][2]["transform_matrix"]), 4)
    document["frames"][2]["transform_matrix"] = rounded.tolist()
    rotation = read_cameras(dump(tmp_path / "t.json", document))[2].extrinsics[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, cameras[2].extrinsics[:3, :3], atol=1e-4)


def test_resized_scales_K_and_tolerates_rounding(cameras):
    camera = cameras[0]  # 640 x 480
    quarter = resize_camera(camera, 160, 120)
    np.testing.assert_allclose(quarter.K[:2], camera.K[:2] / 4)
    assert quarter.distortion == camera.distortion
    assert resize_camera(camera, 213, 160).width == 213  # 640 / 3 is 213.3
    assert resize_camera(camera, 640, 480) is camera
    with pytest.raises(InputError, match=r"480 x 640 .* 640 x 480; .*EXIF"):
        resize_camera(camera, 480, 640)
    with pytest.raises(InputError, match=r"640 x 360 .* 640 x 480; .*at any scale"):
        resize_camera(camera, 640, 360)


def set_pose(change):
    def mutate(document):
        matrix = np.array(document["frames"][1]["transform_matrix"])
        document["frames"][1]["transform_matrix"] = change(matrix).tolist()

    return mutate


def set_frame(**fields):
    return lambda document: document["frames"][1].update(fields)


def drop(field):
    return lambda document: document["frames"][1].pop(field)


MISTAKES = {
    "scaled": (set_pose(lambda m: m @ np.diag([2, 2, 2, 1])), "transform_matrix.*scaled.*2, 2, 2"),
    "slightly scaled": (set_pose(lambda m: m @ np.diag([1.002, 1.002, 1.002, 1])), "transform_matrix.*scaled"),
    "mirrored": (set_pose(lambda m: m @ np.diag([1, 1, -1, 1])), "transform_matrix.*mirrored"),
    "not invertible": (set_pose(lambda m: m @ np.diag([1, 0, 1, 1])), "transform_matrix.*inverted"),
    "transposed": (set_pose(lambda m: m.T), "transform_matrix.*last row"),
    "three rows": (set_pose(lambda m: m[:3]), "transform_matrix.*4 rows of 4"),
    "NaN in pose": (set_pose(lambda m: m * np.nan), "transform_matrix: row 0 is nan"),
    "no pose": (drop("transform_matrix"), "transform_matrix is missing"),
    "text in pose": (set_frame(transform_matrix=[["1", 0, 0, 0]] * 4), "transform_matrix: row 0 is '1'"),
    "far away": (set_pose(lambda m: m + 1e300 * np.eye(4, k=3)), "transform_matrix.*camera is at"),
    "zero focal length": (set_frame(fl_x=0), "focal lengths"),
    "negative focal length": (set_frame(fl_y=-500), "focal lengths"),
    "infinite focal length": (set_frame(fl_x=math.inf), "fl_x is inf"),
    "normalised focal length": (set_frame(fl_x=0.8, fl_y=0.8), "not plausible"),
    "huge number": (set_frame(fl_x=10**400), "fl_x is 1000.*expected a finite number"),
    "no focal length": (drop("fl_x"), "fl_x is missing"),
    "text focal length": (set_frame(fl_x="500"), "fl_x is '500'"),
    "true as number": (set_frame(fl_x=True), "fl_x is True"),
    "wild principal point": (set_frame(cx=5000), "principal point"),
    "zero size": (set_frame(w=0), "w is 0"),
    "negative size": (set_frame(h=-4), "h is -4"),
    "half pixels": (set_frame(w=100.5), "w is 100.5"),
    "huge size": (set_frame(w=1e300), "size"),
    "only one side": (drop("h"), "h is missing"),
    "NaN distortion": (set_frame(k1=math.nan), "k1 is nan"),
    "fourth coefficient": (set_frame(k4=0.1), "k4 is 0.1, expected only k1, k2, p1, p2, k3"),
    "tangential fisheye": (set_frame(camera_model="OPENCV_FISHEYE", p1=0.1), "p1 is 0.1, expected only k1, k2, k3, k4"),
    "unknown lens": (set_frame(camera_model="EQUIRECTANGULAR"), "camera_model is 'EQUIRECTANGULAR'"),
    "text as fisheye": (set_frame(is_fisheye="yes"), "is_fisheye is 'yes'"),
    "list as model": (set_frame(camera_model=[]), "camera_model"),
    "no name": (drop("file_path"), "file_path is missing"),
    "empty name": (set_frame(file_path=""), "file_path is ''"),
    "number as name": (set_frame(file_path=7), "file_path is 7"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_names_file_frame_and_field(tmp_path, cameras, mistake):
    mutate, expected = MISTAKES[mistake]
    document = copy.deepcopy(as_transforms(cameras))
    mutate(document)
    path = dump(tmp_path / "my transforms.json", document)
    with pytest.raises(InputError, match=expected) as caught:
        read_cameras(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: frames[1]") and "\n" not in message


def test_angle_must_be_radians(tmp_path, cameras):
    document = as_transforms(cameras)
    del document["frames"][1]["fl_x"]
    for angle in (50, 0, -1, 5e-324):
        document["camera_angle_x"] = angle
        with pytest.raises(InputError, match="camera_angle_x is"):
            read_cameras(dump(tmp_path / "t.json", document))


def test_names_must_differ(tmp_path, cameras):
    write_cameras(tmp_path / "cameras.json", [*cameras, cameras[1]])
    with pytest.raises(InputError, match=r"cameras\.json.*images/0001\.jpg a second time"):
        read_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "is empty"),
        (b"{", "not valid JSON"),
        (b"\xff\xfe\xfa", "not valid JSON"),
        (b"\x89PNG\r\n\x1a\n", "not valid JSON"),
        (b"[" * 100_000, "nested too deeply"),
        (b"9" * 5000, "not valid JSON"),
        (b"[]", "expected a JSON object"),
        (b"null", "expected a JSON object"),
        (b"{}", "holds no cameras of a known format"),
        (b'{"frames": []}', "frames is .*at least one"),
        (b'{"frames": {"0": 1}}', "frames is .*expected a list"),
        (b'{"frames": [1]}', "frames is .*expected a list"),
        (b'{"format": "idesplat-cameras", "version": 2}', "version is 2"),
        (b'{"format": "idesplat-cameras", "version": 1}', "cameras is missing"),
        (b'{"format": "idesplat-cameras", "version": 1, "cameras": [{}]}', r"cameras\[0\]: image is missing"),
    ],
)
def test_files_that_hold_no_cameras(tmp_path, content, expected):
    (tmp_path / "cameras.json").write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read_cameras(tmp_path / "cameras.json")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.json: cannot be read"):
        read_cameras(tmp_path / "nowhere.json")
    with pytest.raises(InputError, match="is a folder without cameras"):
        read_cameras(tmp_path)
    with pytest.raises(InputError, match="is a folder"):
        read_cameras(tmp_path, camera_format=CameraFormat.OWN)
    with pytest.raises(InputError, match="cannot be read") as refused:  # without looking into it first
        read_cameras(tmp_path / "nowhere.json", camera_format=CameraFormat.OWN)
    assert str(refused.value).count("nowhere.json") == 1


@pytest.mark.parametrize("bad", [[1, 2, 3], "no", [1, 2, 3, None], {"k1": 1}, [1] * 6])
def test_own_format_distortion_is_a_list_of_numbers(tmp_path, cameras, bad):
    write_cameras(tmp_path / "c.json", cameras)
    document = json.loads((tmp_path / "c.json").read_text())
    document["cameras"][2]["distortion"] = bad
    with pytest.raises(InputError, match=r"cameras\[2\] \(images/0002\.jpg\): distortion is"):
        read_cameras(dump(tmp_path / "c.json", document))


# ---- nothing but an InputError or cameras, whatever the file holds

fuzz = settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
# Without subnormal numbers: a library that another test loads may have switched them off in this process.
scalars = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_subnormal=False)
    | st.text(max_size=8)
    | st.just(10**400)
)
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner))
FIELDS = [
    *("file_path", "transform_matrix", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k3", "camera_angle_x"),
    *("camera_model", "is_fisheye", "frames", "cameras", "format", "version", "image", "width", "fx", "extrinsics"),
]


def assert_cameras_or_input_error(path):
    try:
        cameras = read_cameras(path)
    except InputError as error:
        assert str(error).startswith(str(path))
        return
    for camera in cameras:
        assert np.isfinite(camera.K).all() and np.isfinite(camera.extrinsics).all()
        assert camera.width > 0 and camera.height > 0 and camera.K[0, 0] > 0


@pytest.mark.slow
@fuzz
@given(data=st.data())
def test_mutated_values(tmp_path, cameras, data):
    own = data.draw(st.booleans())
    write_cameras(tmp_path / "c.json", cameras)
    document = json.loads((tmp_path / "c.json").read_text()) if own else as_transforms(cameras)
    entry = data.draw(st.sampled_from([document, *document["cameras" if own else "frames"]]))
    for field in data.draw(st.lists(st.sampled_from(FIELDS), min_size=1, max_size=3)):
        entry[field] = data.draw(values)
    if "transform_matrix" in entry and data.draw(st.booleans()):
        row = data.draw(st.lists(scalars, min_size=4, max_size=4))
        entry["transform_matrix"] = [row, row, [0, 0, 1, 0], [0, 0, 0, 1]]
    assert_cameras_or_input_error(dump(tmp_path / "c.json", document))


@fuzz
@given(data=st.data())
def test_mutated_bytes(tmp_path, cameras, data):
    content = bytearray(json.dumps(as_transforms(cameras)).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        content[start : start + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    (tmp_path / "c.json").write_bytes(content)
    assert_cameras_or_input_error(tmp_path / "c.json")


@pytest.mark.slow
@fuzz
@given(document=st.dictionaries(st.sampled_from(FIELDS), values))
def test_random_documents(tmp_path, document):
    assert_cameras_or_input_error(dump(tmp_path / "c.json", document))
