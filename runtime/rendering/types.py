"""What the rasteriser takes and returns, and the constants of compositing.

Compositing as in 3DGS (Kerbl et al. 2023, eq. 3): over the splats i that cover a pixel, nearest first,

    C = sum_i c_i alpha_i T_i + T C_background,    T_i = prod_{j < i} (1 - alpha_j),
    alpha_i = min(opacity_i exp(-d^T Sigma'_i^-1 d / 2), MAX_ALPHA),

d being the pixel's offset from the splat's centre and Sigma' its 2D covariance (`geometry.projection`). As in gsplat,
fragments with alpha below MIN_ALPHA are skipped, and a pixel ends before the fragment that would bring T to 1e-4.

A splat out of focus has a larger Sigma', and an alpha that is smaller by its opacity_scale. This factor comes after the
limits of alpha: a splat ends at the same number of standard deviations as in focus, so that one whose light is spread
over many pixels does not vanish.
"""

from math import log
from typing import NamedTuple

import numpy as np

MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
# log(1e-4), with slack: two fragments at MAX_ALPHA leave exactly 1e-4, and the second must be kept whichever way
# float32 rounds, as it is in float64.
MIN_LOG_TRANSMITTANCE = log(1e-4) - 1e-5
BLOCK_SIZE = 1 << 15  # Gaussians projected at once: the temporaries of a block fit the cache


class Rendering(NamedTuple):
    """A rendered view, all float32.

    rgb: colour over the background, at least 0 and usually at most 1, [height, width, 3].
    alpha: 1 - T after the last fragment, in [0, 1], [height, width].
    depth: sum_i z_i alpha_i T_i, z-depth in world units not divided by alpha: 0 where nothing is, [height, width].
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


class GaussianArrays(NamedTuple):
    """The Gaussians given to `rasterize`, checked, all float32; shapes as in `Gaussians`."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


class View(NamedTuple):
    """The camera given to `rasterize`, checked, the matrices float64."""

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    near: float
    aperture: float  # diameter of the lens, world units; 0 for a pinhole
    focus: float  # z-depth of the plane in focus, world units


# A projected Gaussian, in pixels. One array holds all fields, so that a splat lies in two lines of the cache, and
# sorting copies it as a whole.
#
# An ellipse is evaluated row by row. On the row at distance dy from the centre, the 2D Gaussian with covariance
# (xx, xy, yy) is a 1D Gaussian centred at x + shear * dy, shear = xy / yy, with the variance xx - xy^2 / yy
# (row_variance), and its exponent is lower by dy^2 / (2 yy).
SPLAT = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("shear", np.float64),
        ("row_variance", np.float64),
        ("y_variance", np.float64),
        ("reach", np.float64),  # log(opacity / MIN_ALPHA): how far the exponent may fall until alpha is MIN_ALPHA
        ("opacity_scale", np.float64),  # area of the ellipse in focus / area of this one, at most 1
        ("first_row", np.int64),
        ("rows", np.int64),  # 0 where the splat does not touch the image
        ("columns", np.int64),  # width of the bounding box of the ellipse
        ("features", np.float32, 4),  # red, green, blue, depth
    ]
)
