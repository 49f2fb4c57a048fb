"""A rasteriser of Gaussians for the CPU, compiled by numba, with the semantics of gsplat.

splats -> rows -> fragments -> pixels: each Gaussian is projected to an ellipse, the ellipse is cut into pixel rows, the
rows into fragments (one splat at one pixel), and the fragments of a pixel are composited front to back (`types`). The
image is rendered in bands of rows, in parallel on the machine's cores. A band takes its splats nearest first, as many
at a time as give a bounded number of fragments: memory does not grow with the overdraw, and occluded splats are
skipped. `rasterizer_numpy` holds the same steps in NumPy: the reference that the compiled ones are tested against.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from math import ceil, inf
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from ..errors import InputError
from ..system.threads import thread_count
from .types import BLOCK_SIZE, SPLAT, GaussianArrays, Rendering, View

# NumPy sorts 16-bit integers by radix, several times faster than wider ones, so a band has no more pixels than this.
MAX_BAND_PIXELS = 1 << 16
MAX_PIXELS = 1 << 27  # 20 bytes each, and as much again while the results are put together
MIN_BANDS = 8  # several for each core, so that the cores finish together
MAX_LENS = 1e30  # of the aperture and of 1 / focus, in world units and their inverse: squares do not overflow
MAX_THREADS = 8  # each holds the fragments of a chunk, some 30 MB


def rasterize(
    means: np.ndarray,  # [gaussians, 3]
    quats: np.ndarray,  # [gaussians, 4]
    scales: np.ndarray,  # [gaussians, 3]
    opacities: np.ndarray,  # [gaussians]
    sh: np.ndarray,  # [gaussians, (degree + 1)^2, 3]
    viewmat: np.ndarray,  # [4, 4]
    K: np.ndarray,  # [3, 3]
    width: int,
    height: int,
    background: tuple[float, float, float] | np.ndarray = (0, 0, 0),
    near: float = 0.01,
    aperture: float = 0,
    focus: float | None = None,
) -> Rendering:
    """Render Gaussians from a pinhole camera, with gsplat's arithmetic, or through a thin lens.

    means and scales (standard deviations) are in world units, quats are wxyz and need not be normalised, opacities lie
    in [0, 1], sh is in the basis of 3DGS, degree 0 to 3. viewmat is world-to-camera (OpenCV axes: x right, y down, z
    forward) and rigid; K is in pixels, with pixel centres at .5. Gaussians whose z-depth is not above `near`, in world
    units, are skipped.

    aperture: diameter of the lens in world units, 0 for a pinhole. focus: z-depth of the plane in focus in world units,
    needed where aperture is above 0. What lies at the z-depth z is blurred over aperture * f * |1 / focus - 1 / z|
    pixels, f being K's focal length (`geometry.projection`); alpha and depth are those of the blurred image.

    Raises InputError if an argument has the wrong shape, is not finite, or is not a pinhole camera or lens.
    """
    gaussians = _checked_gaussians(means, quats, scales, opacities, sh)
    view = _checked_view(viewmat, K, width, height, near, *_checked_lens(aperture, focus))
    backdrop = _checked("background", background, (3,))

    band_rows = min(ceil(height / MIN_BANDS), MAX_BAND_PIXELS // width)
    sums = np.empty((height, width, 5), np.float32)  # red, green, blue, depth, alpha

    threads = min(MAX_THREADS, thread_count())
    kernels = _kernels()
    with ThreadPoolExecutor(threads) as pool:
        splats = _project(kernels, gaussians, view, pool)

        def render_band(top: int) -> None:
            sums[top : top + band_rows] = kernels.composite_band(splats, top, min(band_rows, height - top), width)

        list(pool.map(render_band, range(0, height, band_rows)))

    depth, alpha = sums[..., 3].copy(), sums[..., 4].copy()
    return Rendering(sums[..., :3] + (1 - alpha[..., None]) * backdrop, alpha, depth)


@functools.cache
def _kernels() -> ModuleType:
    """The two expensive steps, projection of a block and compositing of a band; compiled when this returns."""
    from . import rasterizer_numba

    rasterizer_numba.compile_all()
    return rasterizer_numba


def _project(kernels: ModuleType, gaussians: GaussianArrays, view: View, pool: ThreadPoolExecutor) -> np.ndarray:
    """The splats that touch the image, nearest first, SPLAT [splats]."""
    count = len(gaussians.means)
    splats = np.zeros(count, SPLAT)
    list(pool.map(lambda start: kernels.project(gaussians, start, view, splats), range(0, count, BLOCK_SIZE)))
    touching = np.flatnonzero(splats["rows"])
    return splats.take(touching[_argsort_depth(splats["features"][touching, 3])])


def _argsort_depth(depth: np.ndarray) -> np.ndarray:
    """A stable argsort [splats] of positive float32 depths.

    Positive floats are in the order of their bits, and NumPy sorts halves of 16 bits by radix: five times faster.
    """
    bits = np.ascontiguousarray(depth).view(np.uint32)
    by_low = np.argsort(bits.astype(np.uint16), kind="stable")
    return by_low[np.argsort((bits >> 16).astype(np.uint16)[by_low], kind="stable")]


def _checked_gaussians(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
) -> GaussianArrays:
    """The arrays as float32, once they agree in length and their values are finite."""
    count = np.shape(means)[0] if np.ndim(means) else 0
    coefficients = np.shape(sh)[1] if np.ndim(sh) == 3 else 1
    if coefficients not in (1, 4, 9, 16):
        raise InputError(f"rasterize: sh has {coefficients} coefficients, expected 1, 4, 9 or 16 (degree 0 to 3)")
    return GaussianArrays(
        _checked("means", means, (count, 3)),
        _checked("quats", quats, (count, 4)),
        _checked("scales", scales, (count, 3)),
        _checked("opacities", opacities, (count,)),
        _checked("sh", sh, (count, coefficients, 3)),
    )


def _checked_lens(aperture: float, focus: float | None) -> tuple[float, float]:
    """The diameter of the lens and the distance in focus, once they are those of a lens."""
    if not 0 <= aperture <= MAX_LENS:
        raise InputError(f"rasterize: aperture is {aperture}, expected a diameter in world units, 0 to {MAX_LENS:g}")
    if focus is None:
        if aperture > 0:
            raise InputError("rasterize: focus is missing; give the z-depth of the plane in focus, in world units")
        return 0.0, inf
    if not focus >= 1 / MAX_LENS:
        raise InputError(f"rasterize: focus is {focus}, expected a positive z-depth in world units")
    return float(aperture), float(focus)


def _checked_view(
    viewmat: np.ndarray, K: np.ndarray, width: int, height: int, near: float, aperture: float, focus: float
) -> View:
    """The camera, once it is a pinhole camera whose image can be rendered."""
    if not (1 <= width <= MAX_BAND_PIXELS and 1 <= height <= MAX_BAND_PIXELS):
        raise InputError(f"rasterize: the image is {width}x{height}, expected sides of 1 to {MAX_BAND_PIXELS} pixels")
    if width * height > MAX_PIXELS:
        raise InputError(f"rasterize: the image is {width}x{height}, expected at most {MAX_PIXELS} pixels in all")
    if not near > 0:
        raise InputError(f"rasterize: near is {near}, expected a positive distance in world units")
    viewmat = _checked("viewmat", viewmat, (4, 4), np.float64)
    K = _checked("K", K, (3, 3), np.float64)
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    if not (np.array_equal(K, pinhole) and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(
            f"rasterize: K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0"
        )
    return View(viewmat, K, width, height, near, aperture, focus)


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
    """`value` as an array of this shape, of finite numbers."""
    if np.shape(value) != shape:
        raise InputError(f"rasterize: {name} has shape {np.shape(value)}, expected {shape}")
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(value, dtype)
    except (TypeError, ValueError):
        raise InputError(f"rasterize: {name} holds {np.asarray(value).dtype}, expected real numbers") from None
    if not np.isfinite(array).all():
        raise InputError(f"rasterize: {name} holds values that are not finite; leave those out")
    return array
