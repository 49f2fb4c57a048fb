"""Draws Gaussians on a CPU with nothing but NumPy, the way gsplat draws them on a GPU.

splats -> rows -> fragments -> pixels: each Gaussian is projected to an ellipse, the ellipse is cut into pixel rows,
the rows into fragments (one splat at one pixel), and the fragments of a pixel are blended front to back. The image is
drawn in bands, side by side on the machine's cores, and a band takes its splats nearest first, as many at a time as
give a bounded number of fragments: memory does not grow with the overdraw, and what is hidden is not drawn.
"""

import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from math import ceil, log
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from .errors import InputError
from .gaussians import SH_0
from .quaternions import rotation_matrices

DILATION = 0.3  # px^2, added to the projected covariance: no splat is thinner than a pixel
FIELD_OF_VIEW_MARGIN = 0.3  # share of the half image by which the Jacobian's direction may leave the image
MIN_ALPHA = 1 / 255  # a fragment below it is not drawn
MAX_ALPHA = 0.99
# Light left below which nothing further is drawn. Two fragments at MAX_ALPHA reach 1e-4 itself; the slack keeps the
# second one whichever way float32 rounds, as exact arithmetic on doubles does.
MIN_LOG_TRANSMITTANCE = log(1e-4) - 1e-5

PROJECTED_AT_ONCE = 1 << 15  # splats: the temporaries of a block stay in the cache
FRAGMENTS_AT_ONCE = 1 << 18  # likewise
# NumPy sorts 16-bit integers by radix, several times faster than wider ones, so a band has no more pixels than this.
BAND_PIXELS = 1 << 16
MAX_PIXELS = 1 << 27  # 20 bytes each, and as much again while the results are put together
MIN_BANDS = 8  # several a core, so that the cores finish together
MOST_THREADS = 8  # each holds the fragments of a chunk, some 30 MB

SH_1 = 0.4886025119029199
SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


class Rendering(NamedTuple):
    """A drawn view, all float32.

    rgb: colour over the background, at least 0 and usually at most 1, [height, width, 3].
    alpha: share of the light that the Gaussians stop, in [0, 1], [height, width].
    depth: view depth in world units weighted by alpha, not divided by it: 0 where nothing is, [height, width].
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


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
) -> Rendering:
    """Draw Gaussians as a pinhole camera sees them, with gsplat's arithmetic.

    means and scales (standard deviations) are in world units, quats are wxyz and need not be normalised, opacities lie
    in [0, 1], sh is in the basis of 3DGS, degree 0 to 3. viewmat takes world to camera (OpenCV axes: x right, y down,
    z forward), rigidly; K is in pixels, with pixel centres at .5. Gaussians whose centre is nearer than `near`, in
    world units along the view axis, are not drawn.

    Raises InputError if an argument has the wrong shape, is not finite, or is not a camera.
    """
    gaussians = _checked_gaussians(means, quats, scales, opacities, sh)
    camera = _checked_camera(viewmat, K, width, height, near)
    backdrop = _checked("background", background, (3,))

    project, draw_band = _steps()
    band_rows = min(ceil(height / MIN_BANDS), BAND_PIXELS // width)
    sums = np.empty((height, width, 5), np.float32)  # red, green, blue, depth, alpha

    with ThreadPoolExecutor(min(MOST_THREADS, os.cpu_count() or 1)) as pool:
        starts = range(0, max(len(gaussians.means), 1), PROJECTED_AT_ONCE)
        blocks = pool.map(lambda start: project(gaussians, start, camera), starts)
        splats = Splats(*map(np.concatenate, zip(*blocks, strict=True)))
        splats = splats.taken(_nearest_first(splats.paint[:, 3]))

        def draw(top: int) -> None:
            sums[top : top + band_rows] = draw_band(splats, top, min(band_rows, height - top), width)

        list(pool.map(draw, range(0, height, band_rows)))

    depth, alpha = sums[..., 3].copy(), sums[..., 4].copy()
    return Rendering(sums[..., :3] + (1 - alpha[..., None]) * backdrop, alpha, depth)


@functools.cache
def _steps() -> tuple[Callable[..., "Splats"], Callable[..., np.ndarray]]:
    """The two heavy steps, projecting a block and drawing a band: compiled where that is possible (extra `fast`)."""
    try:
        from .rasterizer_compiled import draw_band, project
    except (ImportError, RuntimeError):
        return _project, _draw_band
    return project, draw_band


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

    def taken(self, index: np.ndarray | slice) -> "Splats":
        """These splats only, in this order."""
        if isinstance(index, slice):
            return Splats(*(field[index] for field in self))
        return Splats(*(field.take(index, axis=0) for field in self))


def _project(gaussians: Scene, start: int, camera: View) -> Splats:
    """Those Gaussians of the block from `start` on that touch the image, as ellipses, in the order given."""
    block = Scene(*(field[start : start + PROJECTED_AT_ONCE] for field in gaussians))
    points = block.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]  # [block, 3], camera frame
    seen = _where((points[:, 2] > camera.near) & (block.opacities >= MIN_ALPHA))
    points, block = points[seen], Scene(*(field[seen] for field in block))

    splats = _ellipses(points, block, camera)
    touching = _where((splats.rows > 0) & (splats.columns > 0))
    splats = splats.taken(touching)
    splats.paint[:, :3] = _colours(block.means[touching], block.sh[touching], camera.viewmat)
    splats.paint[:, 3] = points[touching, 2]
    return splats


def _where(mask: np.ndarray) -> np.ndarray | slice:
    """An index of what is True: where that is everything, one that copies nothing."""
    return slice(None) if mask.all() else np.flatnonzero(mask)


def _nearest_first(depth: np.ndarray) -> np.ndarray:
    """The order [splats] of positive float32 depths, equal ones as they stand.

    Positive floats are in the order of their bits, and NumPy sorts halves of 16 bits by radix: five times faster.
    """
    bits = np.ascontiguousarray(depth).view(np.uint32)
    by_low = np.argsort(bits.astype(np.uint16), kind="stable")
    return by_low[np.argsort((bits >> 16).astype(np.uint16)[by_low], kind="stable")]


def _ellipses(points: np.ndarray, gaussians: Scene, camera: View) -> Splats:
    """The image of each Gaussian under the projection linearised at its centre, points [splats, 3] in the camera frame.

    That is elliptical weighted averaging. The paint is left to the caller.
    """
    (fx, fy), (cx, cy) = camera.K.diagonal()[:2], camera.K[:2, 2]
    width, height = camera.width, camera.height
    z = points[:, 2]
    across, down = points[:, 0] / z, points[:, 1] / z
    x, y = fx * across + cx, fy * down + cy

    # Far outside the image the linearisation would blow splats up, so its direction stays near the field of view.
    margin_x, margin_y = FIELD_OF_VIEW_MARGIN * 0.5 * width / fx, FIELD_OF_VIEW_MARGIN * 0.5 * height / fy
    across = np.clip(across, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    down = np.clip(down, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    to_camera = camera.viewmat[:3, :3]
    jacobian_x = (fx / z)[:, None] * (to_camera[0] - across[:, None] * to_camera[2])  # [splats, 3]
    jacobian_y = (fy / z)[:, None] * (to_camera[1] - down[:, None] * to_camera[2])
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]  # [splats, 3, 3], as columns, scaled
    half_x = np.einsum("ni,nij->nj", jacobian_x, axes)
    half_y = np.einsum("ni,nij->nj", jacobian_y, axes)
    x_variance = np.einsum("ni,ni->n", half_x, half_x) + DILATION
    y_variance = np.einsum("ni,ni->n", half_y, half_y) + DILATION
    shear = np.einsum("ni,ni->n", half_x, half_y) / y_variance
    # Never below the dilation in exact arithmetic; the difference of two large numbers may be.
    row_variance = np.maximum(x_variance - shear * shear * y_variance, DILATION)

    reach = np.log(gaussians.opacities / MIN_ALPHA, dtype=np.float64)
    first_row, rows = _span(y, np.sqrt(2 * reach * y_variance), height)
    _, columns = _span(x, np.sqrt(2 * reach * x_variance), width)
    paint = np.empty((len(points), 4), np.float32)
    return Splats(x, y, shear, row_variance, y_variance, reach, first_row, rows, columns, paint)


def _span(centre: np.ndarray, half: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First pixel whose centre lies within centre +- half, and how many do, of an image `size` pixels long."""
    first = np.clip(np.ceil(centre - half - 0.5), 0, size)
    last = np.clip(np.floor(centre + half - 0.5), -1, size - 1)
    return first.astype(np.int64), np.maximum(last - first + 1, 0).astype(np.int64)


def _colours(means: np.ndarray, sh: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """Colours [splats, 3] of the Gaussians as seen from the camera's position."""
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    directions = means - position
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    basis = _sh_basis(directions.astype(np.float32), sh.shape[1])
    return np.maximum(np.einsum("nk,nkc->nc", basis, sh) + np.float32(0.5), 0)


def _sh_basis(directions: np.ndarray, coefficients: int) -> np.ndarray:
    """Real spherical harmonics [splats, coefficients] in the order and with the signs of 3DGS, at unit directions."""
    basis = np.empty((len(directions), coefficients), directions.dtype)
    x, y, z = directions.T
    basis[:, 0] = SH_0
    if coefficients > 1:
        basis[:, 1:4] = SH_1 * np.stack([-y, z, -x], axis=1)
    xx, yy, zz = x * x, y * y, z * z
    if coefficients > 4:
        basis[:, 4] = SH_2[0] * x * y
        basis[:, 5] = -SH_2[0] * y * z
        basis[:, 6] = SH_2[1] * (2 * zz - xx - yy)
        basis[:, 7] = -SH_2[0] * x * z
        basis[:, 8] = SH_2[2] * (xx - yy)
    if coefficients > 9:
        basis[:, 9] = -SH_3[0] * y * (3 * xx - yy)
        basis[:, 10] = SH_3[1] * x * y * z
        basis[:, 11] = -SH_3[2] * y * (4 * zz - xx - yy)
        basis[:, 12] = SH_3[3] * z * (2 * zz - 3 * xx - 3 * yy)
        basis[:, 13] = -SH_3[2] * x * (4 * zz - xx - yy)
        basis[:, 14] = SH_3[4] * z * (xx - yy)
        basis[:, 15] = -SH_3[0] * x * (xx - 3 * yy)
    return basis


def _draw_band(splats: Splats, top: int, rows: int, width: int) -> np.ndarray:
    """Sums [rows, width, 5] of red, green, blue, depth and alpha over the image rows from `top` on."""
    last_row = splats.first_row + splats.rows
    splats = splats.taken(np.flatnonzero((splats.first_row < top + rows) & (last_row > top)))
    first_row = np.maximum(splats.first_row, top)
    last_row = np.minimum(splats.first_row + splats.rows, top + rows)
    splats = splats._replace(y=splats.y - top, first_row=first_row - top, rows=last_row - first_row)

    sums = np.zeros((rows * width, 5), np.float32)
    log_transmittance = np.zeros(rows * width)  # counts the fragment that was one too many, which closes the pixel
    for chunk in _chunks(splats):
        is_open = log_transmittance > MIN_LOG_TRANSMITTANCE
        if not is_open.any():
            break
        fragments = _fragments(chunk, width, is_open)
        if len(fragments.pixel):
            _blend(fragments, chunk.paint, sums, log_transmittance)
    return sums.reshape(rows, width, 5)


def _chunks(splats: Splats) -> Iterator[Splats]:
    """Runs of consecutive splats with a bounded number of fragments."""
    most_fragments = np.cumsum(splats.rows * splats.columns)
    start, spent = 0, 0
    while start < len(most_fragments):
        stop = int(np.searchsorted(most_fragments, spent + FRAGMENTS_AT_ONCE, side="right"))
        stop = max(stop, start + 1)
        yield splats.taken(slice(start, stop))
        start, spent = stop, int(most_fragments[stop - 1])


class _Fragments(NamedTuple):
    """What splats leave at pixels, each pixel's nearest first. All [fragments]."""

    pixel: np.ndarray  # uint16, in the band
    splat: np.ndarray  # int64, in the chunk
    alpha: np.ndarray  # float32


def _fragments(splats: Splats, width: int, is_open: np.ndarray) -> _Fragments:
    """The fragments of these splats at open pixels, `is_open` [pixels]."""
    owner, row = _expand(splats.rows)  # [rows]
    row += splats.first_row[owner]
    dy = row + 0.5 - splats.y[owner]
    reach = np.maximum(splats.reach[owner] - dy * dy / (2 * splats.y_variance[owner]), 0)
    row_variance = splats.row_variance[owner]
    centre = splats.x[owner] + splats.shear[owner] * dy
    first, length = _span(centre, np.sqrt(2 * reach * row_variance), width)

    any_closed = not is_open.all()
    start = row * width + first
    if any_closed:
        open_before = np.concatenate([[0], np.cumsum(is_open)])
        length[open_before[start + length] == open_before[start]] = 0
    distance = (first + 0.5 - centre).astype(np.float32)
    sharpness = np.sqrt(0.5 / row_variance).astype(np.float32)
    log_peak = (reach + log(MIN_ALPHA)).astype(np.float32)

    row, column = _expand(length)  # [fragments]
    falloff = (distance[row] + column.astype(np.float32)) * sharpness[row]
    alpha = np.exp(log_peak[row] - falloff * falloff)
    alpha = np.clip(alpha, np.float32(MIN_ALPHA), np.float32(MAX_ALPHA))
    fragments = _Fragments((start[row] + column).astype(np.uint16), owner[row], alpha)
    if any_closed:
        drawn = np.flatnonzero(is_open[fragments.pixel])
        fragments = _Fragments(*(field[drawn] for field in fragments))
    return fragments


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For things that have parts, `counts` [things] each: the thing of every part, and the part's place in it."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _blend(fragments: _Fragments, paint: np.ndarray, sums: np.ndarray, log_transmittance: np.ndarray) -> None:
    """Blend fragments behind what the pixels already hold; adds to sums [pixels, 5] and log_transmittance [pixels]."""
    by_pixel = np.argsort(fragments.pixel, kind="stable")  # each pixel's fragments stay nearest first
    pixel, splat, alpha = (field[by_pixel] for field in fragments)
    starts = np.concatenate([[0], np.flatnonzero(pixel[1:] != pixel[:-1]) + 1])  # [touched pixels]
    ends = np.append(starts[1:], len(pixel))
    touched = pixel[starts]

    # One running sum over all pixels, in float64; each pixel's own begins where its predecessor's ended.
    log_passed = np.log(1 - alpha)
    running = np.cumsum(log_passed.astype(np.float64))
    before = np.concatenate([[0.0], running[ends[:-1] - 1]])
    running += np.repeat(log_transmittance[touched] - before, ends - starts)
    weight = alpha * np.exp((running - log_passed).astype(np.float32))
    weight[running <= MIN_LOG_TRANSMITTANCE] = 0
    log_transmittance[touched] = running[ends - 1]

    painted = weight * np.take(paint.T, splat, axis=1)  # [4, fragments]: long rows, which NumPy is quickest at
    sums[touched, :4] += np.add.reduceat(painted, starts, axis=1).T
    sums[touched, 4] += np.add.reduceat(weight, starts)


def _checked_gaussians(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
) -> Scene:
    """The Gaussians, once the arrays agree in length and their values are finite."""
    count = np.shape(means)[0] if np.ndim(means) else 0
    coefficients = np.shape(sh)[1] if np.ndim(sh) == 3 else 1
    if coefficients not in (1, 4, 9, 16):
        raise InputError(f"rasterize: sh has {coefficients} coefficients, expected 1, 4, 9 or 16 (degree 0 to 3)")
    return Scene(
        _checked("means", means, (count, 3)),
        _checked("quats", quats, (count, 4)),
        _checked("scales", scales, (count, 3)),
        _checked("opacities", opacities, (count,)),
        _checked("sh", sh, (count, coefficients, 3)),
    )


def _checked_camera(viewmat: np.ndarray, K: np.ndarray, width: int, height: int, near: float) -> View:
    """The camera, once it is a pinhole camera with an image that can be drawn."""
    if not (1 <= width <= BAND_PIXELS and 1 <= height <= BAND_PIXELS):
        raise InputError(f"rasterize: the image is {width}x{height}, expected sides of 1 to {BAND_PIXELS} pixels")
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
    return View(viewmat, K, width, height, near)


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
