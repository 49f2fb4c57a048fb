"""Depth maps as a dense workspace of COLMAP, in the layout of its patch_match_stereo.

    images/                     the images at the size of the depth maps, undistorted
    sparse/                     cameras.bin, images.bin, points3D.bin
    stereo/depth_maps/          z-depth, *.geometric.bin
    stereo/normal_maps/         normals in the camera's frame, towards the camera, *.geometric.bin
    stereo/patch-match.cfg, stereo/fusion.cfg

`colmap stereo_fusion --workspace_path DIR --output_path fused.ply` and `pycolmap.stereo_fusion` fuse it to a point
cloud. The points in sparse/, pixels on whose depth at least two views agree, tell which images overlap.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..geometry.consistency import DEPTH_TOLERANCE, project_to_view
from ..geometry.quaternions import matrices_to_quaternions
from ..geometry.rigid import invert_rigid, transform_points
from ..images.colormaps import to_uint8
from ..images.png import save_png
from ..splats.points import unproject
from ..system.files import atomic_write, make_folder
from ..views.batch import ViewBatch
from .predictor import Prediction

PINHOLE = 1  # COLMAP's id of this camera model
POINTS_PER_VIEW = 1000  # in sparse/, about
MIN_TRACK_LENGTH = 2  # observations of a point
SOURCES = "__auto__, 20"  # COLMAP chooses the source images
GEOMETRIC = ".geometric.bin"
OFFSET_FILE = "offset.txt"
SPARSE_FILES = ("cameras.bin", "images.bin", "points3D.bin")
MAP_FOLDERS = ("depth_maps", "normal_maps")
CONFIGURATIONS = ("fusion.cfg", "patch-match.cfg")


def workspace_files(folder: Path, stems: Sequence[str]) -> list[Path]:
    """The files that `write_workspace` may write."""
    names = [f"{stem}.png" for stem in stems]
    maps = [folder / "stereo" / kind / (name + GEOMETRIC) for kind in MAP_FOLDERS for name in names]
    listed = [*(f"sparse/{name}" for name in SPARSE_FILES), *(f"stereo/{name}" for name in CONFIGURATIONS), OFFSET_FILE]
    return [*(folder / "images" / name for name in names), *maps, *(folder / name for name in listed)]


def write_workspace(folder: Path, stems: Sequence[str], prediction: Prediction, views: ViewBatch) -> list[Path]:
    """Write a dense workspace into an existing folder; returns the paths written.

    stems: the images' names without suffix, all different, [views]. views: what was predicted from; what was
    subtracted from the user's world coordinates is written to `offset.txt`, unless it is zero.
    Raises InputError if a file cannot be written.
    """
    names = [f"{stem}.png" for stem in stems]
    images, sparse, stereo = (make_folder(folder / name) for name in ("images", "sparse", "stereo"))
    depth_maps, normal_maps = (make_folder(stereo / name) for name in MAP_FOLDERS)
    make_folder(stereo / "consistency_graphs")
    written = []
    for name, image, depth, camera in zip(names, views.images, prediction.depth, prediction.cameras, strict=True):
        save_png(images / name, image.transpose(1, 2, 0))
        _write_array(depth_maps / (name + GEOMETRIC), depth[None])
        _write_array(normal_maps / (name + GEOMETRIC), normals_of(depth, camera.K))
        written += [images / name, depth_maps / (name + GEOMETRIC), normal_maps / (name + GEOMETRIC)]
    written += _write_sparse(sparse, names, prediction, views)
    fusion, patch_match = (stereo / name for name in CONFIGURATIONS)
    texts = {
        fusion: "".join(f"{name}\n" for name in names),
        patch_match: "".join(f"{name}\n{SOURCES}\n" for name in names),
    }
    if views.offset.any():
        texts[folder / OFFSET_FILE] = " ".join(map(repr, views.offset.tolist())) + "\n"
    for path, text in texts.items():
        with atomic_write(path) as temporary:
            temporary.write_text(text)
    return [*written, *texts]


def normals_of(depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Unit normals of a depth map [height, width], from its neighbouring pixels, float32 [3, height, width].

    In the camera's frame, towards the camera. K: pixels, pixel centres at .5, [3, 3].
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    points = rays * depth[..., None].astype(np.float64)  # [height, width, 3]
    down, right = np.gradient(points, axis=(0, 1))
    normals = np.cross(down, right)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    backwards = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    unit = np.where(lengths > 0, normals / np.where(lengths > 0, lengths, 1), backwards)
    return unit.transpose(2, 0, 1).astype(np.float32)


def _write_array(path: Path, values: np.ndarray) -> None:
    """COLMAP's file format of a map [channels, height, width]: its size as text, then float32 values by channel."""
    channels, height, width = values.shape
    with atomic_write(path) as temporary:
        temporary.write_bytes(f"{width}&{height}&{channels}&".encode() + values.astype("<f4").tobytes())


# ---- the sparse model


def _write_sparse(folder: Path, names: Sequence[str], prediction: Prediction, views: ViewBatch) -> list[Path]:
    """Write cameras.bin, images.bin and points3D.bin, one camera for each image; returns the paths written."""
    points, colours, observed = _sparse_points(prediction, views)
    # Every observation is an entry of its image's list; the points' tracks hold indices into these lists.
    list_indices = np.where(observed, np.cumsum(observed, axis=0) - 1, -1)  # [points, views]
    cameras_bin, images_bin, points_bin = SPARSE_FILES
    content = {
        cameras_bin: _packed([_camera_record(index, camera) for index, camera in enumerate(prediction.cameras, 1)]),
        images_bin: _packed(
            [
                _image_record(index + 1, name, camera, points, np.flatnonzero(observed[:, index]))
                for index, (name, camera) in enumerate(zip(names, prediction.cameras, strict=True))
            ]
        ),
        points_bin: _packed(
            [_point_record(index, points[index], colours[index], list_indices[index]) for index in range(len(points))]
        ),
    }
    for name, data in content.items():
        with atomic_write(folder / name) as temporary:
            temporary.write_bytes(data)
    return [folder / name for name in content]


def _sparse_points(prediction: Prediction, views: ViewBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels on whose depth views agree: world points [points, 3], RGB uint8 [points, 3], observed [points, views]."""
    depth, extrinsics, intrinsics = prediction.depth, views.extrinsics, views.intrinsics.astype(np.float64)
    count, height, width = depth.shape
    step = max(1, round((height * width / POINTS_PER_VIEW) ** 0.5))
    rows, columns = (part.ravel() for part in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    points = unproject(depth, extrinsics, intrinsics)[:, rows, columns].reshape(-1, 3)
    colours = to_uint8(views.images[:, :, rows, columns]).transpose(0, 2, 1).reshape(-1, 3)
    observed = np.zeros((len(points), count), bool)
    for view in range(count):
        pixel, z, inside = project_to_view(points, (height, width), extrinsics[view], intrinsics[view])
        observed[:, view] = inside & (np.abs(depth[view].ravel()[pixel] - z) < DEPTH_TOLERANCE * z)
    agreed = observed.sum(axis=1) >= MIN_TRACK_LENGTH
    return points[agreed], colours[agreed], observed[agreed]


def _packed(records: Sequence[bytes]) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(records)


def _camera_record(number: int, camera: Camera) -> bytes:
    K = camera.K
    parameters = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    return struct.pack("<iiQQ4d", number, PINHOLE, camera.width, camera.height, *parameters)


def _image_record(number: int, name: str, camera: Camera, points: np.ndarray, seen: np.ndarray) -> bytes:
    """An image, its pose world-to-camera, and the pixels at which it observes points."""
    pose = invert_rigid(camera.extrinsics)
    (quat,) = matrices_to_quaternions(pose[None, :3, :3])
    local = transform_points(pose, points[seen])
    pixels = (local / local[:, 2:]) @ camera.K.T
    table = np.zeros(len(seen), [("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
    table["x"], table["y"], table["point"] = pixels[:, 0], pixels[:, 1], seen + 1
    start = struct.pack("<i7di", number, *quat, *pose[:3, 3], number) + name.encode(errors="surrogateescape") + b"\0"
    return start + struct.pack("<Q", len(seen)) + table.tobytes()


def _point_record(index: int, point: np.ndarray, colour: np.ndarray, list_indices: np.ndarray) -> bytes:
    """A point with its track. list_indices: indices in the images' lists [views], negative where not observed."""
    views = np.flatnonzero(list_indices >= 0)
    track = np.stack([views + 1, list_indices[views]], axis=1).astype("<i4")
    return struct.pack("<Q3d3BdQ", index + 1, *point, *colour.tolist(), 0.0, len(views)) + track.tobytes()
