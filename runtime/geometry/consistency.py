"""What depth maps say about themselves and about each other."""

import numpy as np

DEPTH_TOLERANCE = 0.05  # share of the depth by which two views may differ about a surface and still mean the same one


def depth_jumps(depth: np.ndarray) -> np.ndarray:
    """By how much depth [views, height, width] differs among a pixel and its eight neighbours, as a share of it."""
    import cv2

    square = np.ones((3, 3), np.uint8)
    return np.stack([cv2.dilate(view, square) / cv2.erode(view, square) - 1 for view in depth])


def multi_view_consistency(
    points: np.ndarray, depth: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """The share of the other views that confirm each point, float32 [views, height, width].

    points: where the pixels are in the world, [views, height, width, 3]. depth: z-depth, [views, height, width].
    A view confirms a point that lies within 5 % of the depth that it sees there, and denies one that it sees through.
    A view does not judge points outside its picture or behind its surface; a point that none judges gets 1.
    Of two views that contradict each other neither is known to be right; only more views can tell.
    """
    import cv2

    square = np.ones((3, 3), np.uint8)  # a point falls between pixels, so a view says what its neighbours say, too
    confirmed, denied = np.zeros(depth.shape, np.float32), np.zeros(depth.shape, np.float32)
    for other, surface in enumerate(depth):
        nearest, farthest = cv2.erode(surface, square), cv2.dilate(surface, square)
        for view in range(len(depth)):
            if view == other:
                continue
            pixel, z, seen = project_to_view(points[view], surface.shape, extrinsics[other], intrinsics[other])
            behind_nearest = z >= nearest.ravel()[pixel] * (1 - DEPTH_TOLERANCE)
            before_farthest = z <= farthest.ravel()[pixel] * (1 + DEPTH_TOLERANCE)
            confirmed[view] += seen & behind_nearest & before_farthest
            denied[view] += seen & ~behind_nearest
    judged = confirmed + denied
    return np.where(judged > 0, confirmed / np.maximum(judged, 1), 1).astype(np.float32)


def project_to_view(
    points: np.ndarray, shape: tuple[int, ...], extrinsics: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel (row * width + column), z-depth and whether it is in the picture, for points [..., 3], in one view."""
    height, width = shape
    local = (points - extrinsics[:3, 3]) @ extrinsics[:3, :3]  # [..., 3]
    z = local[..., 2]
    x, y, _ = np.moveaxis(local / np.where(z > 0, z, 1)[..., None] @ intrinsics.T, -1, 0)
    seen = (z > 0) & (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
    column, row = (np.where(seen, values, 0) * size for values, size in ((x, width), (y, height)))
    pixel = np.minimum(row.astype(np.int64), height - 1) * width + np.minimum(column.astype(np.int64), width - 1)
    return pixel, z, seen
