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
from ..splats.surfaces import Surfaces, project_to_pixel
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
    images = np.ascontiguousarray(views.images.transpose(0, 2, 3, 1), np.float32)
    unknowns = min(LINEAR, gaussians.sh.shape[1])
    sh = gaussians.sh.copy()

    def fit(view: int) -> None:
        pixels = prediction.depth[view].size
        own = slice(view * pixels, (view + 1) * pixels)
        sh[own, :unknowns] += _changes(surfaces, images, view, unknowns)

    map_in_threads(fit, len(images))
    return replace(prediction, gaussians=replace(gaussians, sh=sh))


def _changes(surfaces: Surfaces, images: np.ndarray, view: int, unknowns: int) -> np.ndarray:
    """What is added to the SH of a view's Gaussians, float32 [pixels, unknowns, 3].

    images: RGB, [views, height, width, 3]. unknowns: 1 for a alone, LINEAR for a and b.
    """
    s, pixels = surfaces, images[view, ..., 0].size
    normal, right = np.zeros((pixels, LINEAR, LINEAR)), np.zeros((pixels, LINEAR, 3))
    centers = np.ascontiguousarray(s.extrinsics[:, :3, 3])
    _collect(s.points[view], s.neighbors[view], s.depth, s.viewmats, s.Ks, centers, images, view, normal, right)
    normal += np.diag([1, STIFFNESS, STIFFNESS, STIFFNESS])
    fitted = np.linalg.solve(normal[:, :unknowns, :unknowns], right[:, :unknowns])
    if unknowns == LINEAR:
        own = s.points[view].reshape(-1, 3) - centers[view]
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        fitted[:, 0] -= np.einsum("pa,pac->pc", own, fitted[:, 1:])
        fitted[:, 1:] = Y_1_SIGNS[:, None] * fitted[:, 1:][:, Y_1_AXES] / SH_1
    fitted[:, 0] /= SH_0
    return fitted.astype(np.float32)


@compiled()
def _collect(
    points: np.ndarray,  # [height, width, 3]
    neighbors: np.ndarray,
    depth: np.ndarray,  # [views, height, width]
    viewmats: np.ndarray,
    Ks: np.ndarray,
    centers: np.ndarray,  # [views, 3]
    images: np.ndarray,  # [views, height, width, 3]
    own: int,
    normal: np.ndarray,  # [height * width, LINEAR, LINEAR]
    right: np.ndarray,  # [height * width, LINEAR, 3]
) -> None:
    """Add up the normal equations for the Gaussians of the view `own`: a row for each neighbour that shows them."""
    height, width = points.shape[:2]
    coefficients, difference = np.ones(LINEAR), np.empty(3)
    for row in range(height):
        for column in range(width):
            point, pixel = points[row, column], row * width + column
            for view in neighbors:
                z, y, x = project_to_pixel(point, viewmats[view], Ks[view], height, width)
                if y < 0 or abs(z - depth[view, y, x]) > DEPTH_TOLERANCE * depth[view, y, x]:
                    continue
                _sample(point, viewmats[view], Ks[view], images[view], difference)
                difference -= images[own, row, column]
                if np.abs(difference).max() > COLOR_TOLERANCE:
                    continue
                _turn(point, centers[view], centers[own], coefficients)
                for one in range(LINEAR):
                    for other in range(LINEAR):
                        normal[pixel, one, other] += coefficients[one] * coefficients[other]
                    for channel in range(3):
                        right[pixel, one, channel] += coefficients[one] * difference[channel]


@compiled()
def _turn(point: np.ndarray, center: np.ndarray, own: np.ndarray, coefficients: np.ndarray) -> None:
    """Fill coefficients [1:] with d_v - d_0."""
    distance, own_distance = 0.0, 0.0
    for axis in range(3):
        distance += (point[axis] - center[axis]) ** 2
        own_distance += (point[axis] - own[axis]) ** 2
    for axis in range(3):
        direction, own_direction = point[axis] - center[axis], point[axis] - own[axis]
        coefficients[1 + axis] = direction / np.sqrt(distance) - own_direction / np.sqrt(own_distance)


@compiled()
def _sample(point: np.ndarray, viewmat: np.ndarray, K: np.ndarray, image: np.ndarray, color: np.ndarray) -> None:
    """Fill the colour [3] of an image [height, width, 3] at a point that lies in it, bilinear."""
    height, width = image.shape[:2]
    x = viewmat[0, 0] * point[0] + viewmat[0, 1] * point[1] + viewmat[0, 2] * point[2] + viewmat[0, 3]
    y = viewmat[1, 0] * point[0] + viewmat[1, 1] * point[1] + viewmat[1, 2] * point[2] + viewmat[1, 3]
    z = viewmat[2, 0] * point[0] + viewmat[2, 1] * point[1] + viewmat[2, 2] * point[2] + viewmat[2, 3]
    u = min(max(K[0, 0] * x / z + K[0, 2] - 0.5, 0.0), width - 1.0)
    v = min(max(K[1, 1] * y / z + K[1, 2] - 0.5, 0.0), height - 1.0)
    left, top = min(int(u), width - 2), min(int(v), height - 2)
    right, below = u - left, v - top
    for channel in range(3):
        upper = image[top, left, channel] * (1 - right) + image[top, left + 1, channel] * right
        lower = image[top + 1, left, channel] * (1 - right) + image[top + 1, left + 1, channel] * right
        color[channel] = upper * (1 - below) + lower * below
