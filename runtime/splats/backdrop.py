"""A coarse layer behind the surfaces and around the frames of the views, which shows where nothing else is seen."""

from math import ceil

import numpy as np

from ..geometry.rigid import transform_points
from ..geometry.sh import SH_0
from .background import find_hidden
from .gaussians import Gaussians
from .surfaces import Surfaces

CELL = 8  # side in pixels of the square that one Gaussian stands for
MARGIN = 0.2  # by which the layer goes on beyond the frame, as a share of its sides
BEHIND = 0.04  # behind the farthest surface of a cell and those around it, relative difference in depth
SAME_SURFACE = 0.05  # pixels that give a cell its colour: relative difference in depth to the farthest
STD = 0.6  # standard deviation, in cells
OPACITY = 0.95
MAGNIFIED = 5.0  # times nearer than its own view, from where a camera sees a cell as a large blot


def make_backdrop(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray, view: int) -> Gaussians:
    """The layer of a view: a round Gaussian for each cell, with the farthest colour and depth around the cell.

    Beyond the frame, colour and depth are those of the nearest pixels inside. What another view sees before a surface
    of its own is left out, and what a camera stands MAGNIFIED times nearer to than the view itself: from between the
    cameras such a Gaussian covers much of the image.

    gaussians: one for each pixel of the view. kept: the pixels whose Gaussians are kept, bool [views, height, width].
    """
    height, width = kept.shape[1:]
    depth = np.where(kept[view], surfaces.depth[view], 0)
    top, left = (ceil(MARGIN * side / CELL) * CELL for side in (height, width))
    around = ((top, top + -height % CELL), (left, left + -width % CELL))
    cells = _cells(np.pad(depth, around, mode="edge"))  # [rows, columns, pixels]
    image = np.moveaxis(gaussians.colours.reshape(height, width, 3), -1, 0)
    colours = np.stack([_cells(np.pad(channel, around, mode="edge")) for channel in image], axis=-1)
    farthest, colour = _farthest(cells, colours)

    K, pose = surfaces.Ks[view], surfaces.extrinsics[view]
    row, column = np.nonzero(farthest > 0)
    z = farthest[row, column] * (1 + BEHIND)
    x = ((column + 0.5) * CELL - left - K[0, 2]) / K[0, 0]
    y = ((row + 0.5) * CELL - top - K[1, 2]) / K[1, 1]
    points = transform_points(pose, np.stack([x, y, np.ones_like(x)], axis=-1) * z[:, None])
    hidden = np.zeros(len(points), bool)
    find_hidden(points, surfaces.neighbors[view], surfaces.depth, kept, surfaces.viewmats, surfaces.Ks, hidden)
    hidden &= _nearest_camera(points, surfaces.extrinsics) > z / MAGNIFIED

    count = int(hidden.sum())
    scales = np.repeat((STD * CELL * z[hidden] / K[0, 0])[:, None], 3, axis=1)
    sh = np.zeros((count, gaussians.sh.shape[1], 3), np.float32)
    sh[:, 0] = (colour[row, column][hidden] - 0.5) / SH_0
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    opacities = np.full(count, OPACITY, np.float32)
    return Gaussians(points[hidden].astype(np.float32), scales.astype(np.float32), quats, opacities, sh)


def _nearest_camera(points: np.ndarray, extrinsics: np.ndarray) -> np.ndarray:
    """The distance of each point [points, 3] to the nearest camera, [points]."""
    return np.linalg.norm(points[:, None] - extrinsics[:, :3, 3], axis=-1).min(axis=1)


def _cells(values: np.ndarray) -> np.ndarray:
    """Values [height, width] by cell, [height / CELL, width / CELL, CELL^2]."""
    rows, columns = values.shape[0] // CELL, values.shape[1] // CELL
    return values.reshape(rows, CELL, columns, CELL).transpose(0, 2, 1, 3).reshape(rows, columns, CELL * CELL)


def _farthest(depth: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest depth in each cell and the eight around it, and the mean colour of the pixels near that depth.

    depth: [rows, columns, pixels], 0 where unknown. colours: [rows, columns, pixels, 3]. Returns [rows, columns], 0
    where all is unknown, and [rows, columns, 3].
    """
    rows, columns = depth.shape[:2]
    depth = np.pad(depth, ((1, 1), (1, 1), (0, 0)))
    colours = np.pad(colours, ((1, 1), (1, 1), (0, 0), (0, 0)))
    shifts = [(slice(down, down + rows), slice(right, right + columns)) for down in range(3) for right in range(3)]
    farthest = np.max([depth[shift].max(axis=-1) for shift in shifts], axis=0)
    total, weight = np.zeros((rows, columns, 3)), np.zeros((rows, columns))
    for shift in shifts:
        near = depth[shift] > (1 - SAME_SURFACE) * farthest[..., None]
        total += (colours[shift] * near[..., None]).sum(axis=2)
        weight += near.sum(axis=2)
    return farthest, total / np.maximum(weight, 1)[..., None]
