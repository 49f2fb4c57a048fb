"""EWA projection: the image of a 3D Gaussian under a pinhole camera, linearised at its mean.

Zwicker et al. 2001, "EWA Volume Splatting", as 3DGS and gsplat use it. Let t be a Gaussian's mean in the camera frame,
W the rotation world-to-camera, R and S the Gaussian's rotation and scales. Its 2D covariance in pixels^2 is

    Sigma' = J W Sigma W^T J^T + EPS2D I,    Sigma = R S S^T R^T,

    J = [ fx / tz      0      -fx tx / tz^2 ]
        [    0      fy / tz   -fy ty / tz^2 ]

The first row of J W is fx / tz (W_0 - (tx / tz) W_2), W_i being rows of W, so only the slopes tx / tz and ty / tz
enter. gsplat clamps them to the field of view, widened by FOV_MARGIN: far outside the image the linearisation would
make splats arbitrarily large.

Depth of field: a thin lens of diameter A, in world units, has the z-depth F in focus. Through the point u of the lens,
the point (X, z) of the camera frame meets the plane in focus at u + (X - u) F / z, and each point of that plane has one
image, so that of (X, z) is

    f X / z + f u (1 / F - 1 / z),

the pinhole's and a share of u. f is that of K: the distance from the lens to the sensor, in pixels. Over the whole lens
this is the circle of confusion, anywhere in the image a disc of the diameter

    d = A f |1 / F - 1 / z| = A f |z - F| / (z F)  pixels.

As in DOF-GS (Wang et al. 2024, arXiv:2405.17351) each Gaussian is blurred by the circle of confusion of its mean; here
the disc becomes a Gaussian of the same variance, d^2 / 16 along an axis, which is added to Sigma'. The opacity falls by
the ratio of areas sqrt(det Sigma' / det (Sigma' + d^2 / 16 I)), so that the integral over the image stays, as with the
2D Mip filter of Mip-Splatting (Yu et al. 2024).

`rendering.rasterizer_numba` repeats this arithmetic for one splat at a time, and `tools.training.rasterizer` in torch;
both take the constants from here.
"""

from typing import NamedTuple

import numpy as np

from .quaternions import quaternions_to_matrices

EPS2D = 0.3  # px^2, added to the diagonal of the 2D covariance: gsplat's low-pass filter, so no splat is below a pixel
FOV_MARGIN = 0.3  # share of half the image by which the slopes may leave the field of view, as in gsplat

DISC_STD = 0.25  # standard deviation along an axis of a uniform disc of diameter 1


class ProjectedGaussians(NamedTuple):
    """Means in pixels and 2D covariances in pixels^2 of Gaussians, all float64 [gaussians]."""

    x: np.ndarray
    y: np.ndarray
    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray


def project_gaussians(
    camera_means: np.ndarray,  # [gaussians, 3], in the camera frame, z > 0
    quats: np.ndarray,  # [gaussians, 4], wxyz
    scales: np.ndarray,  # [gaussians, 3]
    rotation: np.ndarray,  # [3, 3], world-to-camera
    K: np.ndarray,  # [3, 3], pixels
    width: int,
    height: int,
) -> ProjectedGaussians:
    """Project Gaussians to the image: means and 2D covariances Sigma' (see above), EPS2D included."""
    (fx, fy), (cx, cy) = K.diagonal()[:2], K[:2, 2]
    z = camera_means[:, 2]
    slope_x, slope_y = camera_means[:, 0] / z, camera_means[:, 1] / z
    x, y = fx * slope_x + cx, fy * slope_y + cy
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    slope_x = np.clip(slope_x, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    slope_y = np.clip(slope_y, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    jacobian_x = (fx / z)[:, None] * (rotation[0] - slope_x[:, None] * rotation[2])  # rows of J W, [gaussians, 3]
    jacobian_y = (fy / z)[:, None] * (rotation[1] - slope_y[:, None] * rotation[2])
    axes = quaternions_to_matrices(quats) * scales[:, None, :]  # R S, [gaussians, 3, 3]
    half_x = np.einsum("ni,nij->nj", jacobian_x, axes)  # rows of J W R S, [gaussians, 3]
    half_y = np.einsum("ni,nij->nj", jacobian_y, axes)
    return ProjectedGaussians(
        x,
        y,
        np.einsum("ni,ni->n", half_x, half_x) + EPS2D,
        np.einsum("ni,ni->n", half_x, half_y),
        np.einsum("ni,ni->n", half_y, half_y) + EPS2D,
    )


def defocus_variances(
    z: np.ndarray,  # [gaussians], z-depth > 0
    K: np.ndarray,  # [3, 3], pixels
    aperture: float,
    focus: float,
) -> tuple[np.ndarray, np.ndarray]:
    """What a thin lens adds to the 2D covariances' xx and yy (see above), in pixels^2, [gaussians] each.

    aperture: diameter of the lens, world units; focus: z-depth of the plane in focus, world units. The two differ where
    the pixels are not square.
    """
    std = DISC_STD * aperture * (1 / focus - 1 / z)  # of the disc where the focal length is one pixel
    return (K[0, 0] * std) ** 2, (K[1, 1] * std) ** 2
