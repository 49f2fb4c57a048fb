"""Meshes from depth maps: triangles between neighbouring pixels, cut at depth discontinuities."""

import numpy as np

MAX_DEPTH_JUMP = 0.05  # fraction of the nearest corner's depth by which the corners of a triangle may differ


def faces_from_depth(depth: np.ndarray, max_depth_jump: float = MAX_DEPTH_JUMP) -> np.ndarray:
    """Triangles between the pixels of each view, indices into all pixels in the order view, row, column, [faces, 3].

    depth: z-depth, [views, height, width]. The triangles face the camera. Those whose depths differ by more than
    `max_depth_jump` of the smallest are left out: they would connect foreground and background.
    """
    pixels = np.arange(depth.size).reshape(depth.shape)
    corners = [pixels[:, :-1, :-1], pixels[:, 1:, :-1], pixels[:, :-1, 1:], pixels[:, 1:, 1:]]
    top_left, bottom_left, top_right, bottom_right = (corner.ravel() for corner in corners)
    upper = np.stack([top_left, bottom_left, top_right], axis=1)
    lower = np.stack([top_right, bottom_left, bottom_right], axis=1)
    faces = np.concatenate([upper, lower])
    distances = depth.ravel()[faces]
    return faces[distances.max(axis=1) <= (1 + max_depth_jump) * distances.min(axis=1)]
