"""Colours that change with the direction of view, as the images of several views show them.

Surfaces look different from each view: highlights and reflections move, and so does the photographer's shadow. The
network gives the Gaussians of a view the colours of its image, so that where views meet there are seams. Here each
Gaussian's SH of degrees 0 and 1 are fitted to the images of all views that show its surface.

Let d_v be the unit direction from view v to a Gaussian of view 0, and c_v the image's colour there. The Gaussian's
colour is changed by a + b (d - d_0), which minimises, for each channel,

    a^2 + STIFFNESS |b|^2 + sum_v (a + b (d_v - d_0) - (c_v - c_0))^2

over the other views v whose depth agrees with the Gaussian's, and whose colour is not that of something else.
"""

from dataclasses import replace

import numpy as np

from ..geometry.sh import SH_0, SH_1
from ..inference.predictor import Prediction
from ..splats.surfaces import Surfaces, bilinear, project
from ..system.compilation import compiled
from ..system.threads import map_in_threads
from ..views.batch import ViewBatch

MIN_VIEWS = 3  # halfway between two views the Gaussians of both mix, which gives the same
DEPTH_TOLERANCE = 0.08  # relative difference in depth up to which a view shows a Gaussian's surface
COLOR_TOLERANCE = 0.7  # greatest difference of a channel at which it does
STIFFNESS = 0.05  # directions differ by some tenths
LINEAR = 4  # coefficients of SH up to degree 1
Y_1_AXES, Y_1_SIGNS = [1, 2, 0], np.array([-1, 1, -1], np.float32)  # of degree 1, the basis is SH_1 (-y, z, -x)


def fit_view_colors(prediction: Prediction, views: ViewBatch, voters: list[np.ndarray]) -> Prediction:
    """The prediction with SH that follow the colours of all views; as it is with fewer than MIN_VIEWS.

    Gaussians with SH of degree 0 get a, the mean change, alone; degrees above 1 stay as they are.
    voters: for each view, the others that are asked, as arrays of indices.
    """
    if len(views.names) < MIN_VIEWS:
        return prediction
    gaussians = prediction.need_gaussians()
    points = gaussians.means.reshape(*prediction.depth.shape, 3)
    surfaces = Surfaces(points, prediction.depth, views.extrinsics, views.intrinsics, None, voters)
    unknowns = min(LINEAR, gaussians.sh.shape[1])
    sh = gaussians.sh.copy()

    def fit(view: int) -> None:
        pixels = prediction.depth[view].size
        own = slice(view * pixels, (view + 1) * pixels)
        sh[own, :unknowns] += _changes(surfaces, views.images, view, unknowns)

    map_in_threads(fit, len(views.names))
    return replace(prediction, gaussians=replace(gaussians, sh=sh))


def _changes(surfaces: Surfaces, images: np.ndarray, view: int, unknowns: int) -> np.ndarray:
    """What is added to the SH of a view's Gaussians, float32 [pixels, unknowns, 3].

    images: RGB, [views, 3, height, width]. unknowns: 1 for a alone, LINEAR for a and b.
    """
    s, pixels = surfaces, surfaces.depth[view].size
    normal, right = np.zeros((pixels, LINEAR, LINEAR)), np.zeros((pixels, LINEAR, 3))
    centers = np.ascontiguousarray(s.extrinsics[:, :3, 3])
    directions = s.points[view] - centers[view]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    of_view = s.points[view], directions, images[view], s.neighbors[view]
    _collect(*of_view, s.depth, s.viewmats, s.Ks, centers, images, normal, right)
    normal += np.diag([1, STIFFNESS, STIFFNESS, STIFFNESS])
    fitted = np.linalg.solve(normal[:, :unknowns, :unknowns], right[:, :unknowns])
    if unknowns == LINEAR:
        fitted[:, 0] -= np.einsum("pa,pac->pc", directions.reshape(-1, 3), fitted[:, 1:])
        fitted[:, 1:] = Y_1_SIGNS[:, None] * fitted[:, 1:][:, Y_1_AXES] / SH_1
    fitted[:, 0] /= SH_0
    return fitted.astype(np.float32)


@compiled()
def _collect(
    points: np.ndarray,  # [height, width, 3]
    directions: np.ndarray,  # [height, width, 3], d_0
    own: np.ndarray,  # [3, height, width]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    centers: np.ndarray,  # [views, 3]
    images: np.ndarray,  # [views, 3, height, width]
    normal: np.ndarray,  # [height * width, LINEAR, LINEAR]
    right: np.ndarray,  # [height * width, LINEAR, 3]
) -> None:
    """Add up the normal equations for the Gaussians of a view: an equation for each neighbour that shows them."""
    height, width = points.shape[:2]
    coefficients, difference, ray = np.ones(LINEAR), np.empty(3), np.empty(3)
    for row in range(height):
        for column in range(width):
            for view in neighbors:
                z, x, y = project(points[row, column], viewmats[view], Ks[view])
                if z <= 0 or not (0 <= x < width and 0 <= y < height):
                    continue
                surface = depth[view, int(y), int(x)]
                if abs(z - surface) > DEPTH_TOLERANCE * surface:
                    continue
                for channel in range(3):
                    difference[channel] = bilinear(images[view, channel], x, y) - own[channel, row, column]
                if np.abs(difference).max() > COLOR_TOLERANCE:
                    continue
                for axis in range(3):
                    ray[axis] = points[row, column, axis] - centers[view, axis]
                length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
                for axis in range(3):
                    coefficients[1 + axis] = ray[axis] / length - directions[row, column, axis]
                _add(coefficients, difference, normal[row * width + column], right[row * width + column])


@compiled()
def _add(coefficients: np.ndarray, difference: np.ndarray, normal: np.ndarray, right: np.ndarray) -> None:
    """Add an equation, coefficients [LINEAR] times the unknowns is the difference [3], to the normal equations."""
    for one in range(LINEAR):
        for other in range(LINEAR):
            normal[one, other] += coefficients[one] * coefficients[other]
        for channel in range(3):
            right[one, channel] += coefficients[one] * difference[channel]
