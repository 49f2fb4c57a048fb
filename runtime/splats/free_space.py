"""The free space that the cameras moved through: Gaussians in it hide the scene from views between the given ones.

Refinement and fusion look from the given cameras alone. A few Gaussians of wrong depths right before a camera that
stands between two of them, and that neither sees well, cover its image like fog.
"""

from collections.abc import Iterator

import numpy as np

from ..geometry.intrinsics import denormalize_intrinsics
from ..geometry.rigid import invert_rigid
from ..geometry.trajectories import interpolate_extrinsics
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from .surfaces import project_to_pixel

NEIGHBORS = 4  # cameras that each one is joined with
FRAMES = 5  # cameras from one to another, both included
NEAREST = 0.01  # share of a view's pixels that may be nearer than its nearest surface: depth maps have outliers
FREE = 0.5  # of the nearest surface's depth, up to where there is nothing
REACH = 1.5  # times this depth, up to where views are joined: between them, one is nearer than the surface
MARGIN = 0.1  # of the image's sides, by which a camera between two may see more than they do
SIDE = 100  # pixels of an image, for its bounds alone
ENLARGED = round(SIDE * (1 + 2 * MARGIN))
BLOCK = 1 << 14  # Gaussians of one task


def find_in_free_space(
    means: np.ndarray, depth: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """The Gaussians right before a view or a camera between neighbouring views, bool [gaussians].

    Right before is in its image, enlarged by MARGIN, and at less than FREE of the depth of the nearest surface that
    these views see. Only views whose distance is at most REACH times that depth are neighbours: steps around an object
    lead through free space, and a straight line to its other side does not.

    means: [gaussians, 3]. depth: z-depth, [views, height, width]. extrinsics: camera-to-world, OpenCV axes,
    [views, 4, 4]. intrinsics: normalised by width and height, [views, 3, 3].
    """
    cameras = list(_cameras(depth, extrinsics.astype(np.float64)))
    viewmats = np.stack([invert_rigid(pose) for _, pose, _ in cameras])
    Ks = denormalize_intrinsics(intrinsics[[view for view, _, _ in cameras]].astype(np.float64), SIDE, SIDE)
    Ks[:, :2, 2] += MARGIN * SIDE
    limits = np.array([limit for _, _, limit in cameras])
    found = np.zeros(len(means), np.bool_)

    def find(block: int) -> None:
        part = slice(block * BLOCK, (block + 1) * BLOCK)
        _find(means[part], viewmats, Ks, limits, found[part])

    map_in_threads(find, -(-len(means) // BLOCK))
    return found


def _cameras(depth: np.ndarray, extrinsics: np.ndarray) -> Iterator[tuple[int, np.ndarray, float]]:
    """The views, and the cameras between neighbours: a view with its intrinsics, the pose, the depth that is free."""
    nearest = np.quantile(depth.reshape(len(depth), -1), NEAREST, axis=1)
    centres, joined = extrinsics[:, :3, 3], set()
    for view, centre in enumerate(centres):
        yield view, extrinsics[view], FREE * nearest[view]
        distances = np.linalg.norm(centres - centre, axis=1)
        for other in np.argsort(distances, kind="stable")[: NEIGHBORS + 1].tolist():
            surface = min(nearest[view], nearest[other])
            pair = min(view, other), max(view, other)
            if other == view or pair in joined or distances[other] > REACH * surface:
                continue
            joined.add(pair)
            for pose in interpolate_extrinsics(extrinsics[list(pair)], FRAMES)[1:-1]:
                yield view, pose, FREE * surface


@compiled()
def _find(
    means: np.ndarray,  # [gaussians, 3]
    viewmats: np.ndarray,  # [cameras, 4, 4]
    Ks: np.ndarray,  # [cameras, 3, 3], of images with ENLARGED pixels a side
    limits: np.ndarray,  # [cameras]: depth that is free
    found: np.ndarray,  # [gaussians]
) -> None:
    """Find the means that a camera sees nearer than its limit."""
    for index in range(len(means)):
        for camera in range(len(viewmats)):
            away, row, _ = project_to_pixel(means[index], viewmats[camera], Ks[camera], ENLARGED, ENLARGED)
            if row >= 0 and away < limits[camera]:
                found[index] = True
                break
