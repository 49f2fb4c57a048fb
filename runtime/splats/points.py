"""Coloured point clouds and meshes from depth maps or Gaussians, and their files.

trimesh writes .ply, .obj and .glb. Coordinates are those of the cameras, but in .glb they have glTF's axes (x left, y
up, z forward) and colours are linear. `.xyz` has a line x y z r g b for each point.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..images.colormaps import srgb_to_linear, to_uint8
from ..system.files import atomic_write
from .axes import GLTF
from .gaussians import Gaussians

# Formats of `write_point_cloud` and `write_mesh`.
POINT_SUFFIXES = (".ply", ".glb", ".obj", ".xyz")
MESH_SUFFIXES = (".ply", ".glb", ".obj")


@dataclass(frozen=True)
class PointCloud:
    """Coloured points.

    positions: world units and axes of the cameras given, float32 [points, 3].
    colours: RGB, uint8 [points, 3].
    """

    positions: np.ndarray
    colours: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


def points_from_depth(
    depth: np.ndarray, images: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray
) -> PointCloud:
    """A point for each pixel in the order view, row, column: its centre at its depth, in its colour.

    depth: z-depth in world units, [views, height, width]. images: RGB in [0, 1], [views, 3, height, width].
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4]. intrinsics: normalised by width and height, [views, 3, 3].
    """
    positions = unproject(depth, extrinsics, intrinsics)
    colours = to_uint8(images).transpose(0, 2, 3, 1)
    return PointCloud(positions.reshape(-1, 3).astype(np.float32), colours.reshape(-1, 3))


def unproject(depth: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """World coordinates of every pixel's centre, float64 [views, height, width, 3]; arguments as above."""
    views, height, width = depth.shape
    rays = pixel_rays(intrinsics, height, width).reshape(views, -1, 3)
    points = rays * depth.reshape(views, -1, 1)
    return (points @ extrinsics[:, :3, :3].swapaxes(1, 2) + extrinsics[:, None, :3, 3]).reshape(*depth.shape, 3)


def pixel_rays(intrinsics: np.ndarray, height: int, width: int) -> np.ndarray:
    """The rays through the pixels' centres in the camera's frame, with z = 1, float64 [..., height, width, 3].

    intrinsics: normalised, [..., 3, 3].
    """
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    pixels = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(intrinsics.astype(np.float64)).swapaxes(-1, -2)
    return np.asarray(rays.reshape(*intrinsics.shape[:-2], height, width, 3))


def points_from_gaussians(gaussians: Gaussians) -> PointCloud:
    """The mean of every Gaussian, in the colour of SH degree 0."""
    return PointCloud(gaussians.means, to_uint8(gaussians.colours))


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write points in the format of the path's suffix; raises InputError if the file cannot be written."""
    import trimesh

    if path.suffix.lower() == ".glb" and not len(cloud):
        raise InputError(f"cannot write {path}: there are no points, and a .glb has no empty arrays")
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".xyz":
            np.savetxt(temporary, np.column_stack([cloud.positions, cloud.colours]), "%.9g %.9g %.9g %d %d %d")
        else:
            positions, colours = _converted(path, cloud)
            _export(trimesh.PointCloud(positions, colors=colours), temporary)


def write_mesh(path: Path, cloud: PointCloud, faces: np.ndarray) -> None:
    """Write a mesh with vertex colours in the format of the path's suffix; raises InputError as above.

    faces: indices of three points each, counterclockwise seen from the front, [faces, 3].
    """
    import trimesh

    positions, colours = _converted(path, cloud)
    with atomic_write(path) as temporary:
        _export(trimesh.Trimesh(positions, faces, vertex_colors=colours, process=False), temporary)


def _converted(path: Path, cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """Positions and colours in the conventions of the path's format."""
    if path.suffix.lower() != ".glb":
        return cloud.positions, cloud.colours
    return cloud.positions * np.array(GLTF, np.float32), to_uint8(srgb_to_linear(cloud.colours / 255))


def _export(geometry: Any, temporary: Path) -> None:
    content = geometry.export(file_type=temporary.suffix[1:].lower())
    temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
