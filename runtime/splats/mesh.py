"""Depth maps as surfaces: neighbouring pixels joined by triangles, except where the depth jumps."""

import numpy as np

LARGEST_JUMP = 0.05  # share of the depth by which the corners of a triangle may differ


def faces_from_depth(depth: np.ndarray, largest_jump: float = LARGEST_JUMP) -> np.ndarray:
    """Triangles between the pixels of each view, as indices into all pixels ordered by view, row, column, [faces, 3].

    depth: z-depth, [views, height, width]. They face the camera, and none joins pixels whose depths differ by more than
    `largest_jump` of the nearer one: there, one thing stands before another.
    """
    pixels = np.arange(depth.size).reshape(depth.shape)
    corners = [pixels[:, :-1, :-1], pixels[:, 1:, :-1], pixels[:, :-1, 1:], pixels[:, 1:, 1:]]
    top_left, bottom_left, top_right, bottom_right = (corner.ravel() for corner in corners)
    upper = np.stack([top_left, bottom_left, top_right], axis=1)
    lower = np.stack([top_right, bottom_left, bottom_right], axis=1)
    faces = np.concatenate([upper, lower])
    distances = depth.ravel()[faces]
    return faces[distances.max(axis=1) <= (1 + largest_jump) * distances.min(axis=1)]
