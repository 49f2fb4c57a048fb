"""What rasterisers take and give, and the constants of EWA splatting (Zwicker et al. 2001) as gsplat has them."""

from math import log
from typing import NamedTuple

import numpy as np

EPS2D = 0.3  # px^2, added to the projected covariance: no splat is thinner than a pixel
FOV_MARGIN = 0.3  # share of the half image by which the Jacobian's direction may leave the image
MIN_ALPHA = 1 / 255  # a fragment below it is not drawn
MAX_ALPHA = 0.99
# Light left below which nothing further is drawn. Two fragments at MAX_ALPHA reach 1e-4 itself; the slack keeps the
# second one whichever way float32 rounds, as exact arithmetic on doubles does.
MIN_LOG_TRANSMITTANCE = log(1e-4) - 1e-5


class Rendering(NamedTuple):
    """A drawn view, all float32.

    rgb: colour over the background, at least 0 and usually at most 1, [height, width, 3].
    alpha: share of the light that the Gaussians stop, in [0, 1], [height, width].
    depth: view depth in world units weighted by alpha, not divided by it: 0 where nothing is, [height, width].
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


class Scene(NamedTuple):
    """The arguments of `rasterize` that stand for the scene, checked, all float32."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


class View(NamedTuple):
    """The arguments of `rasterize` that stand for the view, checked, the matrices float64."""

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    near: float


class Splats(NamedTuple):
    """Projected Gaussians that touch the image, in pixels. All [splats], float64 unless said otherwise.

    An ellipse is kept row by row: on the row at distance dy from the centre it is a 1-D Gaussian centred at
    x + shear * dy with variance row_variance, its peak lower by dy^2 / (2 * y_variance).
    """

    x: np.ndarray
    y: np.ndarray
    shear: np.ndarray
    row_variance: np.ndarray
    y_variance: np.ndarray
    reach: np.ndarray  # log(opacity / MIN_ALPHA): how far the exponent may fall
    first_row: np.ndarray  # int64
    rows: np.ndarray  # int64
    columns: np.ndarray  # int64, width of the box around the ellipse
    paint: np.ndarray  # [splats, 4] float32: red, green, blue, depth

    def select(self, index: np.ndarray | slice) -> "Splats":
        """These splats only, in this order."""
        if isinstance(index, slice):
            return Splats(*(field[index] for field in self))
        return Splats(*(field.take(index, axis=0) for field in self))


PROJECTED_AT_ONCE = 1 << 15  # splats: the temporaries of a block stay in the cache
