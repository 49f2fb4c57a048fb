"""Coloured point clouds: a point for each pixel, where its depth puts it, written by trimesh."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .files import replacing

# What `write_point_cloud` knows to write, by trimesh's names for it.
POINT_SUFFIXES = (".ply", ".glb")


@dataclass(frozen=True)
class PointCloud:
    """Points with colours.

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
    """Every pixel's centre at its depth, in its colour, ordered by view, row, column.

    depth: z-depth in world units, [views, height, width]. images: RGB in [0, 1], [views, 3, height, width].
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4]. intrinsics: normalised by width and height, [views, 3, 3].
    """
    _, height, width = depth.shape
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    pixels = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(intrinsics.astype(np.float64)).swapaxes(1, 2)  # [views, height * width, 3], z = 1
    points = rays * depth.reshape(len(depth), -1, 1)
    positions = points @ extrinsics[:, :3, :3].swapaxes(1, 2) + extrinsics[:, None, :3, 3]
    colours = np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8).transpose(0, 2, 3, 1)
    return PointCloud(positions.reshape(-1, 3).astype(np.float32), colours.reshape(-1, 3))


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a binary `.ply` or a `.glb`, by the path's suffix; raises InputError if the file cannot be written."""
    import trimesh

    content = trimesh.PointCloud(cloud.positions, colors=cloud.colours).export(file_type=path.suffix[1:])
    with replacing(path) as temporary:
        temporary.write_bytes(content)
