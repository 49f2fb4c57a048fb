"""Known cameras, written in every format by other means than the readers under test."""

import cv2
import numpy as np
import pycolmap
from idesplat.runtime.cameras.camera import Camera

TOLERANCE = 1e-6


WIDTH, HEIGHT = 640, 480


K = np.array([[510.25, 0, 301.5], [0, 498.75, 251.125], [0, 0, 1]])  # off centre


POINTS = np.array([[x, y, 4.0 + 0.5 * x - y] for x in (-1.0, -0.4, 0.2, 0.6, 0.9) for y in (-0.8, -0.3, 0.1, 0.7)])


def pose(angles, position):
    """Camera-to-world [4, 4] from a rotation vector in radians and a position."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array(angles, dtype=float))[0]
    matrix[:3, 3] = position
    return matrix


def known(names, matrix=K, **changes):
    """A camera for each name, with different poses."""
    return [
        Camera(name, WIDTH, HEIGHT, matrix, pose((0.1 * i, -0.2, 0.1), (0.5 * i, -0.25, 1 / 3)), **changes)
        for i, name in enumerate(names)
    ]


def inverse(camera):
    """World-to-camera by general inversion, [4, 4]."""
    return np.linalg.inv(camera.extrinsics)


def assert_same(read, expected):
    """The same cameras in the same order, numbers within TOLERANCE."""
    assert [camera.name for camera in read] == [camera.name for camera in expected]
    for ours, theirs in zip(read, expected, strict=True):
        assert (ours.width, ours.height, ours.fisheye) == (theirs.width, theirs.height, theirs.fisheye)
        np.testing.assert_allclose(ours.distortion or [], theirs.distortion or [], rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(ours.K, theirs.K, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(ours.extrinsics, theirs.extrinsics, rtol=0, atol=TOLERANCE)


def save_images(folder, names, width=WIDTH, height=HEIGHT):
    """Write black images of these names into a folder; its files in order."""
    folder.mkdir(exist_ok=True)
    for name in names:
        assert cv2.imwrite(str(folder / name), np.zeros((height, width, 3), np.uint8))
    return sorted(folder.iterdir())


def colmap_model(cameras, model="PINHOLE", parameters=(510.25, 498.75, 301.5, 251.125)):
    """A reconstruction in which every image sees all POINTS."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model=model, width=WIDTH, height=HEIGHT, params=list(parameters))
    reconstruction.add_camera_with_trivial_rig(camera)
    for image_id, camera in enumerate(cameras, start=3):
        image = pycolmap.Image(name=camera.name, camera_id=7, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0])) for _ in POINTS])
        world_to_camera = inverse(camera)
        rotation = pycolmap.Rotation3d(world_to_camera[:3, :3])
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, world_to_camera[:3, 3]))
    for index, point in enumerate(POINTS):
        track = pycolmap.Track([pycolmap.TrackElement(image_id, index) for image_id in reconstruction.images])
        reconstruction.add_point3D(point, track, np.zeros(3, np.uint8))
    return reconstruction


def as_re10k(cameras):
    """The text of a RealEstate10K camera file."""
    lines = ["https://www.youtube.com/watch?v=0123456789a"]
    for camera in cameras:
        values = [K[0, 0] / WIDTH, K[1, 1] / HEIGHT, K[0, 2] / WIDTH, K[1, 2] / HEIGHT, 0, 0, *inverse(camera)[:3].flat]
        lines.append(" ".join([camera.name, *(f"{value:.9f}" for value in values)]))
    return "\n".join(lines) + "\n"


def as_llff(cameras, bounds=(1.5, 20.0)):
    """The rows of LLFF's poses_bounds.npy, [cameras, 17]."""
    rows = []
    for camera in cameras:
        right, down, forward, position = camera.extrinsics[:3].T
        size = np.array([camera.height, camera.width, camera.K[0, 0]])
        rows.append([*np.stack([down, right, -forward, position, size], axis=1).flat, *bounds])
    return np.array(rows)


CENTRED = np.array([[510.25, 0, WIDTH / 2], [0, 510.25, HEIGHT / 2], [0, 0, 1]])


def as_cam_txt(camera, matrix, depths):
    """The text of a *_cam.txt of DTU or MVSNet; `depths` is its last line."""
    rows = ["extrinsic", *(" ".join(map(repr, row)) for row in inverse(camera).tolist()), "", "intrinsic"]
    return "\n".join([*rows, *(" ".join(map(repr, row)) for row in matrix.tolist()), "", depths, ""])


DISTORTIONS = [(0.1, -0.05, 0.001, 0.002, 0.01), (-0.2, 0.03, 0.0, -0.001, 0.0)]


MATRICES = [K, np.array([[505.0, 0, 330.5], [0, 507.0, 222.0], [0, 0, 1]])]


STEREO = pose((0.02, -0.1, 0.01), (-120.0, 1.5, 2.0))  # first camera to second


def write_stereo(path, names=("M{}", "D{}", "R", "T"), size=None, rotation=STEREO[:3, :3]):
    """Write a stereo calibration as OpenCV's samples do; `size`: how it holds the image size, if at all."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for index in (0, 1):
        storage.write(names[0].format(index + 1), MATRICES[index])
        storage.write(names[1].format(index + 1), np.array([DISTORTIONS[index]]))
    storage.write(names[2], rotation)
    storage.write(names[3], STEREO[:3, 3:])
    if size == "sequence":
        storage.startWriteStruct("imageSize", cv2.FileNode_SEQ)
        storage.write("", WIDTH)
        storage.write("", HEIGHT)
        storage.endWriteStruct()
    elif size:
        storage.write("image_width", WIDTH)
        storage.write("image_height", HEIGHT)
    storage.release()
