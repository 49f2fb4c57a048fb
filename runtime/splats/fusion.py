"""Fusion of Gaussians that several views predicted: those that other views see through are left out.

A pixel's Gaussian is contradicted by a view that sees a surface farther away in the same direction (a free-space
violation, as in depth map fusion: Merrell et al. 2007). A Gaussian outside the image of a view, or behind its surface,
is unseen there, and that says nothing about it.
"""

import numpy as np

from ..geometry.consistency import project_to_view

TOLERANCE = 0.02  # relative difference of depth up to which two views mean the same surface
ROUNDS = 3  # the Gaussians that a round leaves out contradict nothing in the next
OWN_VOTE = 0.5  # of the view that predicted the Gaussian, in views
CONTRADICTION_RATIO = 0.5  # votes against a Gaussian that outweigh one for it
UNSEEN = -1


def contradicted(
    points: np.ndarray,  # [views, height, width, 3]
    depth: np.ndarray,  # [views, height, width]
    extrinsics: np.ndarray,  # [views, 4, 4]
    intrinsics: np.ndarray,  # [views, 3, 3]
) -> np.ndarray:
    """The pixels whose Gaussian stands in front of surfaces that more views agree on, bool [views, height, width].

    points: where the pixels are in the world, in the unit of depth (z-depth). extrinsics: camera-to-world, OpenCV axes.
    intrinsics: normalised. Each view that measures the same depth at a point votes for it. Each pixel that is
    seen through votes against it, with as many votes as views agree with that pixel. Of two views that contradict each
    other neither is left out, since neither has a vote: only a third view can tell.
    """
    support = np.zeros(depth.shape, np.float32)
    blocked: list[tuple[int, int, np.ndarray]] = []  # view, other view, the other's pixel that is hidden, or UNSEEN
    for view in range(len(depth)):
        for other in range(len(depth)):
            if other == view:
                continue
            pixel, z, seen = project_to_view(points[view], depth[other].shape, extrinsics[other], intrinsics[other])
            surface = depth[other].ravel()[pixel]
            support[view] += seen & (np.abs(z - surface) < TOLERANCE * surface)
            in_front = seen & (z < surface * (1 - TOLERANCE))
            blocked.append((view, other, np.where(in_front, pixel, UNSEEN).astype(np.int32)))
    left_out = np.zeros(depth.shape, bool)
    for _ in range(ROUNDS):
        votes = np.where(left_out, 0, support)
        against = np.zeros(depth.shape, np.float32)
        for view, other, pixel in blocked:
            against[view] += np.where(pixel == UNSEEN, 0, votes[other].ravel()[np.maximum(pixel, 0)])
        left_out = against > CONTRADICTION_RATIO * (support + OWN_VOTE)
    return left_out
