"""The same known cameras, written in every format by another way than we read it, come back the same."""

import subprocess
import sys

import cv2
import numpy as np
import pycolmap
import pytest
from camera_cases import (
    CENTRED,
    DISTORTIONS,
    HEIGHT,
    MATRICES,
    POINTS,
    STEREO,
    TOLERANCE,
    WIDTH,
    K,
    as_cam_txt,
    as_llff,
    as_re10k,
    assert_same,
    colmap_model,
    inverse,
    known,
    save_images,
    write_stereo,
)
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.io import CameraFormat, detect_format, read_cameras, write_cameras
from idesplat.runtime.errors import InputError

# ---- transforms.json: our writer against the reader; test_cameras.py writes it by hand


@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [(None, False), ((0.1, -0.05, 0.001, 0.002, 0.03), False), ((0.1, -0.05, 0.02, -0.004), True)],
)
def test_both_json_files_are_read_as_written(tmp_path, distortion, fisheye):
    cameras = known(["a/0.png", "a/1.png"], distortion=distortion, fisheye=fisheye)
    for name, form in (("cameras.json", CameraFormat.OWN), ("transforms.json", CameraFormat.TRANSFORMS)):
        write_cameras(tmp_path / name, cameras)
        assert detect_format(tmp_path / name) is form
        assert_same(read_cameras(tmp_path / name), cameras)
    assert detect_format(tmp_path) is CameraFormat.TRANSFORMS
    assert_same(read_cameras(tmp_path), cameras)


def test_the_own_file_keeps_ranges_and_many_coefficients(tmp_path):
    cameras = known(["0"], distortion=tuple(np.linspace(-0.1, 0.2, 12)), depth_range=(0.5, 7.25))
    write_cameras(tmp_path / "c.json", cameras)
    (camera,) = read_cameras(tmp_path / "c.json")
    assert camera.distortion == cameras[0].distortion and camera.depth_range == (0.5, 7.25)
    with pytest.raises(InputError, match=r"0: has 12 distortion coefficients.*can hold k1, k2, p1, p2, k3"):
        write_cameras(tmp_path / "transforms.json", cameras)


def test_fisheye_of_instant_ngp(tmp_path):
    flat = '{"is_fisheye": true, "w": 640, "h": 480, "fl_x": 200, "k1": 0.1, "k3": 0.02, "frames": [{"file_path": "a", '
    (tmp_path / "t.json").write_text(flat + f'"transform_matrix": {np.eye(4).tolist()}}}]}}')
    (camera,) = read_cameras(tmp_path / "t.json")
    assert camera.fisheye and camera.distortion == (0.1, 0, 0.02, 0)


# ---- COLMAP, written by pycolmap, and by hand

COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ([510.25, 301.5, 251.125], None, False),
    "PINHOLE": ([510.25, 498.75, 301.5, 251.125], None, False),
    "SIMPLE_RADIAL": ([510.25, 301.5, 251.125, 0.07], (0.07, 0, 0, 0), False),
    "RADIAL": ([510.25, 301.5, 251.125, 0.07, -0.02], (0.07, -0.02, 0, 0), False),
    "OPENCV": ([510.25, 498.75, 301.5, 251.125, 0.07, -0.02, 0.001, 0.002], (0.07, -0.02, 0.001, 0.002), False),
    "FULL_OPENCV": (
        [510.25, 498.75, 301.5, 251.125, 0.07, -0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06],
        (0.07, -0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06),
        False,
    ),
    "SIMPLE_RADIAL_FISHEYE": ([510.25, 301.5, 251.125, 0.07], (0.07, 0, 0, 0), True),
    "RADIAL_FISHEYE": ([510.25, 301.5, 251.125, 0.07, -0.02], (0.07, -0.02, 0, 0), True),
    "OPENCV_FISHEYE": ([510.25, 498.75, 301.5, 251.125, 0.07, -0.02, 0.001, 0.002], (0.07, -0.02, 0.001, 0.002), True),
}


@pytest.mark.parametrize("model", COLMAP_MODELS)
def test_colmap_cameras(tmp_path, model):
    parameters, distortion, fisheye = COLMAP_MODELS[model]
    fy = 498.75 if 498.75 in parameters else 510.25
    matrix = np.array([[510.25, 0, 301.5], [0, fy, 251.125], [0, 0, 1]])
    cameras = known(["b/0.jpg", "b/1.jpg", "c.jpg"], matrix, distortion=distortion, fisheye=fisheye)
    colmap_model(cameras, model, parameters).write_binary(tmp_path)
    assert detect_format(tmp_path) is CameraFormat.COLMAP
    assert_same(read_cameras(tmp_path), cameras)


@pytest.mark.parametrize("layout", ["binary", "text", "old binary", "old text"])
def test_colmap_layouts(tmp_path, layout):
    cameras = known(["0.jpg", "1.jpg"])
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    reconstruction = colmap_model(cameras)
    reconstruction.write_text(model) if "text" in layout else reconstruction.write_binary(model)
    if "old" in layout:
        for part in model.glob("[rf]*"):  # rigs, frames
            part.unlink()
    suffix = ".txt" if "text" in layout else ".bin"
    for path in (model, tmp_path, tmp_path / "sparse", model / f"images{suffix}"):
        assert_same(read_cameras(path), cameras)
    for camera, known_camera in zip(read_cameras(model), cameras, strict=True):
        depths = (POINTS @ inverse(known_camera)[2, :3] + inverse(known_camera)[2, 3]).tolist()
        near, far = camera.depth_range
        assert 0.4 * min(depths) < near < min(depths) and max(depths) < far < 3 * max(depths)


def test_colmap_rig_of_two_cameras(tmp_path):
    """A pose of the second camera is the rig's pose, then its place in the rig."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 2, 3
    options.num_points3D = 40
    reconstruction = pycolmap.synthesize_dataset(options)
    reconstruction.write(tmp_path)
    (rig,) = reconstruction.rigs.values()
    read = {camera.name: camera for camera in read_cameras(tmp_path)}
    assert len(read) == 6
    for image in reconstruction.images.values():
        place = np.vstack([image.frame.rig_from_world.matrix(), (0, 0, 0, 1)])
        if not rig.is_ref_sensor(image.data_id.sensor_id):
            place = np.vstack([rig.sensor_from_rig(image.data_id.sensor_id).matrix(), (0, 0, 0, 1)]) @ place
        np.testing.assert_allclose(inverse(read[image.name]), place, rtol=0, atol=TOLERANCE)


def test_colmap_from_its_documentation(tmp_path):
    (tmp_path / "cameras.txt").write_text("# Camera list\n1 OPENCV 640 480 500 501 320.5 240.5 0.1 0.2 0.3 0.4\n")
    # A quarter turn about y: w2c takes the world's z to x. IMAGE_ID, QW QX QY QZ, TX TY TZ, CAMERA_ID, NAME, points.
    half = np.sqrt(0.5)
    (tmp_path / "images.txt").write_text(f"9 {half} 0 {half} 0 1 2 3 1 folder/a.png\n\n")
    (tmp_path / "points3D.txt").write_text("")
    (camera,) = read_cameras(tmp_path)
    assert camera.name == "folder/a.png" and camera.distortion == (0.1, 0.2, 0.3, 0.4)
    assert camera.depth_range is None
    np.testing.assert_allclose(camera.K, [[500, 0, 320.5], [0, 501, 240.5], [0, 0, 1]], atol=TOLERANCE)
    np.testing.assert_allclose(camera.extrinsics[:3, 2], [-1, 0, 0], atol=TOLERANCE)  # it looks along -x
    np.testing.assert_allclose(camera.extrinsics[:3, :3] @ [1, 2, 3] + camera.extrinsics[:3, 3], 0, atol=TOLERANCE)


def test_colmap_mistakes(tmp_path, monkeypatch):
    colmap_model(known(["0.jpg"]), "THIN_PRISM_FISHEYE", [500, 500, 320, 240, *[0] * 8]).write_binary(tmp_path)
    with pytest.raises(InputError, match=r"0\.jpg: camera model THIN_PRISM_FISHEYE.*image_undistorter"):
        read_cameras(tmp_path)
    for number in "01":
        (tmp_path / "two" / number).mkdir(parents=True)
        colmap_model(known(["0.jpg"])).write_binary(tmp_path / "two" / number)
    with pytest.raises(InputError, match="holds 2 COLMAP models; give one of them"):
        read_cameras(tmp_path / "two")
    for number in "01":
        (tmp_path / "two" / number / "points3D.bin").unlink()
    with pytest.raises(InputError, match="expected the files cameras, images, points3D"):
        read_cameras(tmp_path / "two", camera_format=CameraFormat.COLMAP)
    pycolmap.Reconstruction().write_binary(tmp_path)
    with pytest.raises(InputError, match="no registered image"):
        read_cameras(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pycolmap is needed; pip install "idesplat\[colmap\]"'):
        read_cameras(tmp_path)


# ---- RealEstate10K


def test_re10k(tmp_path):
    cameras = known(["52553000", "52586000", "52619000"])
    (tmp_path / "0000cc6d8b108390.txt").write_text(as_re10k(cameras))
    assert detect_format(tmp_path / "0000cc6d8b108390.txt") is CameraFormat.RE10K
    with pytest.raises(InputError, match=r"no image is named by one of its 3 timestamps.*--images"):
        read_cameras(tmp_path / "0000cc6d8b108390.txt")
    paths = save_images(tmp_path / "frames", ["52586000.png", "52619000.png"])
    assert_same(read_cameras(tmp_path / "0000cc6d8b108390.txt", paths), cameras)
    assert_same(read_cameras(tmp_path / "0000cc6d8b108390.txt", paths, CameraFormat.RE10K), cameras)


# ---- LLFF


def test_llff(tmp_path):
    cameras = known(["IMG_10.png", "IMG_2.png"], CENTRED)  # LLFF sorts character by character
    np.save(tmp_path / "poses_bounds.npy", as_llff(cameras))
    assert detect_format(tmp_path / "poses_bounds.npy") is CameraFormat.LLFF
    assert [camera.name for camera in read_cameras(tmp_path)] == ["000", "001"]
    paths = save_images(tmp_path / "images", ["IMG_2.png", "IMG_10.png"])
    for given in ([], paths, paths[:1]):
        read = read_cameras(tmp_path / "poses_bounds.npy", given)
        assert_same(read, cameras)
        assert read[0].depth_range == (0.75 * 1.5, 1.5 * 20.0)
    paths[0].unlink()
    with pytest.raises(InputError, match="holds 2 cameras without names, and 1 images were given"):
        read_cameras(tmp_path / "poses_bounds.npy", paths[1:])


def test_llff_axes():
    """The axes as LLFF's README has them: down, right, backwards; a camera at rest then looks along -z, y up."""
    rest = Camera("a", WIDTH, HEIGHT, CENTRED, np.diag([1.0, -1, -1, 1]))
    np.testing.assert_array_equal(as_llff([rest])[0, :15].reshape(3, 5)[:, :3], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


# ---- DTU and MVSNet


@pytest.mark.parametrize(
    ("depths", "expected"),
    [("425.0 2.5", (425, 425 + 2.5 * 191)), ("425 2.5 100", (425, 425 + 2.5 * 99)), ("1.5 .1 64 9.75", (1.5, 9.75))],
)
def test_cam_txt(tmp_path, depths, expected):
    cameras = known(["00000000.png", "00000003.png"])
    (tmp_path / "cams").mkdir()
    for camera in cameras:
        (tmp_path / "cams" / camera.name.replace(".png", "_cam.txt")).write_text(as_cam_txt(camera, K, depths))
    (tmp_path / "cams" / "pair.txt").write_text("2\n")
    with pytest.raises(InputError, match=r"00000000_cam\.txt: gives no size in pixels.*--images"):
        read_cameras(tmp_path / "cams")
    save_images(tmp_path / "images", [camera.name for camera in cameras])
    assert detect_format(tmp_path / "cams") is detect_format(tmp_path / "cams" / "00000003_cam.txt") is CameraFormat.DTU
    read = read_cameras(tmp_path / "cams")
    assert_same(read, cameras)
    assert read[0].depth_range == expected
    assert_same(read_cameras(tmp_path / "cams" / "00000003_cam.txt"), cameras[1:])
    (tmp_path / "cams" / "00000003_cam.txt").write_text("")
    with pytest.raises(InputError) as refused:
        read_cameras(tmp_path / "cams")
    empty = tmp_path / "cams" / "00000003_cam.txt"
    assert str(refused.value) == f"{empty}: is empty; expected a file of cameras"  # once


def test_dtu_counts_images_from_one_and_may_give_K_for_a_quarter(tmp_path):
    cameras = known(["rect_001_3_r5000.png", "rect_004_3_r5000.png"])
    paths = save_images(tmp_path / "scan1", [camera.name for camera in cameras])
    for camera, number in zip(cameras, (0, 3), strict=True):
        quarter = np.diag([0.25, 0.25, 1]) @ K
        (tmp_path / f"{number:08}_cam.txt").write_text(as_cam_txt(camera, quarter, "425 2.5"))
    assert_same(read_cameras(tmp_path, paths), cameras)


# ---- OpenCV's stereo calibration


def assert_stereo(cameras):
    """OpenCV's own projection of points, half a pixel on, is ours."""
    for camera, matrix, distortion, view in zip(cameras, MATRICES, DISTORTIONS, (np.eye(4), STEREO), strict=True):
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose(camera.distortion, distortion, rtol=0, atol=TOLERANCE)
        points = POINTS * 100
        rotation = cv2.Rodrigues(view[:3, :3])[0]
        seen = cv2.projectPoints(points, rotation, view[:3, 3], matrix, None)[0][:, 0] + 0.5
        projected = (points @ inverse(camera)[:3, :3].T + inverse(camera)[:3, 3]) @ camera.K.T
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], seen, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
@pytest.mark.parametrize("size", ["sequence", "numbers", None])
def test_stereo_calibration(tmp_path, suffix, size):
    path = tmp_path / f"stereo{suffix}"
    write_stereo(path, size=size)
    assert detect_format(path) is CameraFormat.OPENCV
    paths = save_images(tmp_path / "pair", ["im0.png", "im1.png"])
    cameras = read_cameras(path, paths)
    assert [camera.name for camera in cameras] == ["im0.png", "im1.png"]
    assert_stereo(cameras)
    if size:
        assert [camera.name for camera in read_cameras(path)] == ["left", "right"]
    else:
        with pytest.raises(InputError, match="camera 1: has no imageSize"):
            read_cameras(path)
    with pytest.raises(InputError, match="calibrates two cameras, but 1 images are given"):
        read_cameras(path, paths[:1])


@pytest.mark.parametrize("size", ["rows: 99999999", "cols: -1", "cols: 4", "rows: 0", "rows: 3.5", "rows: x"])
def test_a_stereo_matrix_whose_size_does_not_fit_its_data_is_refused(size, tmp_path):
    """cv2.FileNode.mat() corrupts the memory of the process for these."""
    path = tmp_path / "stereo.yml"
    write_stereo(path, size="numbers")
    good, name = path.read_text(), size.partition(":")[0]
    before, after = good.split(f"{name}: 3", 1)
    path.write_text(before + size + after)
    with pytest.raises(InputError, match="expected a matrix"):
        read_cameras(path, [])


@pytest.mark.parametrize("names", [("K{}", "D{}", "R", "T"), ("cameraMatrix{}", "distCoeffs{}", "R", "T")])
def test_stereo_calibration_by_other_names(tmp_path, names):
    write_stereo(tmp_path / "s.yml", names, "numbers", rotation=cv2.Rodrigues(STEREO[:3, :3])[0])
    (tmp_path / "s.yml").rename(tmp_path / "stereo")  # the content tells what it is
    assert_stereo(read_cameras(tmp_path / "stereo"))


def test_stereo_calibration_in_two_files(tmp_path):
    """As OpenCV's sample stereo_calib.cpp writes it."""
    write_stereo(tmp_path / "whole.yml", size="numbers")
    text = (tmp_path / "whole.yml").read_text()
    start, end = text.index("R: !!opencv"), text.index("image_width")
    (tmp_path / "extrinsics.yml").write_text("%YAML:1.0\n---\n" + text[start:end])
    with pytest.raises(InputError, match="has no imageSize"):
        read_cameras(tmp_path / "extrinsics.yml", camera_format=CameraFormat.OPENCV)
    (tmp_path / "intrinsics.yml").write_text(text[:start] + text[end:])
    for name in ("intrinsics.yml", "extrinsics.yml"):
        assert_stereo(read_cameras(tmp_path / name))


# ---- what is common


def test_unknown_content_names_what_is_known(tmp_path):
    (tmp_path / "notes.txt").write_text("hello\n")
    with pytest.raises(InputError, match=r"no cameras of a known format.*COLMAP.*--camera-format"):
        read_cameras(tmp_path / "notes.txt")


def test_reading_colmap_leaves_pycolmap_out_of_this_process(tmp_path):
    colmap_model(known(["0.jpg"])).write_binary(tmp_path)
    code = (
        "import sys; from idesplat import read_cameras; "
        f"assert len(read_cameras({str(tmp_path)!r})) == 1 and 'pycolmap' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
