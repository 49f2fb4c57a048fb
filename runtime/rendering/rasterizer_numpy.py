"""The rasteriser's two expensive steps in NumPy, projection and compositing: the reference for the compiled ones."""

from collections.abc import Iterator
from math import log
from typing import NamedTuple

import numpy as np

from ..geometry.projection import EPS2D, defocus_variances, project_gaussians
from ..geometry.rigid import transform_points
from ..geometry.sh import sh_basis
from .types import BLOCK_SIZE, MAX_ALPHA, MIN_ALPHA, MIN_LOG_TRANSMITTANCE, SPLAT, GaussianArrays, View

CHUNK_FRAGMENTS = 1 << 18  # composited at once: the temporaries of a chunk fit the cache


def project(gaussians: GaussianArrays, start: int, view: View, splats: np.ndarray) -> None:
    """Fill the splats of the block of Gaussians from `start` on; splats: SPLAT [gaussians], zeros."""
    block = GaussianArrays(*(field[start : start + BLOCK_SIZE] for field in gaussians))
    camera_means = transform_points(view.viewmat, block.means)  # [block, 3]
    visible = np.flatnonzero((camera_means[:, 2] > view.near) & (block.opacities >= MIN_ALPHA))
    camera_means, block = camera_means[visible], GaussianArrays(*(field[visible] for field in block))

    seen = _ellipses(camera_means, block, view)
    seen["features"][:, :3] = _colours(block.means, block.sh, view.viewmat)
    seen["features"][:, 3] = camera_means[:, 2]
    splats[start + visible] = seen


def _ellipses(camera_means: np.ndarray, gaussians: GaussianArrays, view: View) -> np.ndarray:
    """The splats, with the box that alpha >= MIN_ALPHA fits in. `features` is left to the caller.

    camera_means: means in the camera frame, [splats, 3].
    """
    projected = project_gaussians(
        camera_means, gaussians.quats, gaussians.scales, view.viewmat[:3, :3], view.K, view.width, view.height
    )
    x, y, xx, xy, yy = projected
    blur_x, blur_y = defocus_variances(camera_means[:, 2], view.K, view.aperture, view.focus)
    x_variance, y_variance = xx + blur_x, yy + blur_y
    _, focused_row_variance = _shear_rows(xx, xy, yy)
    shear, row_variance = _shear_rows(x_variance, xy, y_variance)
    # row_variance * y_variance is the determinant of the covariance.
    splats = np.zeros(len(camera_means), SPLAT)
    splats["opacity_scale"] = np.sqrt(np.minimum(focused_row_variance / row_variance * (yy / y_variance), 1))
    splats["x"], splats["y"], splats["shear"] = x, y, shear
    splats["row_variance"], splats["y_variance"] = row_variance, y_variance
    splats["reach"] = reach = np.log(gaussians.opacities / MIN_ALPHA, dtype=np.float64)
    splats["first_row"], rows = _span(y, np.sqrt(2 * reach * y_variance), view.height)
    _, splats["columns"] = _span(x, np.sqrt(2 * reach * x_variance), view.width)
    splats["rows"] = np.where(splats["columns"] > 0, rows, 0)
    return splats


def _shear_rows(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """shear and row_variance of covariances, as in `SPLAT`."""
    shear = xy / yy
    # At least EPS2D in exact arithmetic; the difference of two large numbers may be less.
    return shear, np.maximum(xx - shear * shear * yy, EPS2D)


def _span(centre: np.ndarray, half: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The first pixel whose centre lies within centre +- half, and their number, along a side of `size` pixels."""
    first = np.clip(np.ceil(centre - half - 0.5), 0, size)
    last = np.clip(np.floor(centre + half - 0.5), -1, size - 1)
    return first.astype(np.int64), np.maximum(last - first + 1, 0).astype(np.int64)


def _colours(means: np.ndarray, sh: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """Colours [splats, 3] of the Gaussians in the directions from the camera."""
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    directions = means - position
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    basis = sh_basis(directions.astype(np.float32), sh.shape[1])
    return np.maximum(np.einsum("nk,nkc->nc", basis, sh) + np.float32(0.5), 0)


def composite_band(splats: np.ndarray, top: int, rows: int, width: int) -> np.ndarray:
    """Composited sums [rows, width, 5] of red, green, blue, depth and alpha, for the image rows from `top` on."""
    first_row, end_row = splats["first_row"], splats["first_row"] + splats["rows"]
    splats = splats.take(np.flatnonzero((first_row < top + rows) & (end_row > top)))
    first_row = np.maximum(splats["first_row"], top)
    end_row = np.minimum(splats["first_row"] + splats["rows"], top + rows)
    splats["y"] -= top
    splats["first_row"], splats["rows"] = first_row - top, end_row - first_row

    sums = np.zeros((rows * width, 5), np.float32)
    log_transmittance = np.zeros(rows * width)  # includes the first fragment that was skipped, which ends the pixel
    for chunk in _chunks(splats):
        is_open = log_transmittance > MIN_LOG_TRANSMITTANCE
        if not is_open.any():
            break
        fragments = _fragments(chunk, width, is_open)
        if len(fragments.pixel):
            _composite(fragments, chunk["features"], sums, log_transmittance)
    return sums.reshape(rows, width, 5)


def _chunks(splats: np.ndarray) -> Iterator[np.ndarray]:
    """Runs of consecutive splats whose boxes have CHUNK_FRAGMENTS pixels at most."""
    box_pixels = np.cumsum(splats["rows"] * splats["columns"])
    start, spent = 0, 0
    while start < len(box_pixels):
        stop = int(np.searchsorted(box_pixels, spent + CHUNK_FRAGMENTS, side="right"))
        stop = max(stop, start + 1)
        yield splats[start:stop]
        start, spent = stop, int(box_pixels[stop - 1])


class _Fragments(NamedTuple):
    """Splats at pixels, each pixel's nearest first. All [fragments]."""

    pixel: np.ndarray  # uint16, in the band
    splat: np.ndarray  # int64, in the chunk
    alpha: np.ndarray  # float32


def _fragments(splats: np.ndarray, width: int, is_open: np.ndarray) -> _Fragments:
    """The fragments of these splats at open pixels, `is_open` [pixels]."""
    owner, row = _expand(splats["rows"])  # [rows]
    row += splats["first_row"][owner]
    dy = row + 0.5 - splats["y"][owner]
    reach = np.maximum(splats["reach"][owner] - dy * dy * (0.5 / splats["y_variance"])[owner], 0)
    row_variance = splats["row_variance"][owner]
    centre = splats["x"][owner] + splats["shear"][owner] * dy
    first, length = _span(centre, np.sqrt(2 * reach * row_variance), width)

    any_closed = not is_open.all()
    start = row * width + first
    if any_closed:
        open_before = np.concatenate([[0], np.cumsum(is_open)])
        length[open_before[start + length] == open_before[start]] = 0
    distance = (first + 0.5 - centre).astype(np.float32)
    sharpness = np.sqrt(0.5 / row_variance).astype(np.float32)
    log_peak = (reach + log(MIN_ALPHA)).astype(np.float32)
    opacity_scale = splats["opacity_scale"][owner].astype(np.float32)

    row, column = _expand(length)  # [fragments]
    falloff = (distance[row] + column.astype(np.float32)) * sharpness[row]
    alpha = np.exp(log_peak[row] - falloff * falloff)
    alpha = np.clip(alpha, np.float32(MIN_ALPHA), np.float32(MAX_ALPHA)) * opacity_scale[row]
    fragments = _Fragments((start[row] + column).astype(np.uint16), owner[row], alpha)
    if any_closed:
        kept = np.flatnonzero(is_open[fragments.pixel])
        fragments = _Fragments(*(field[kept] for field in fragments))
    return fragments


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Owners and positions of the parts of owners that have `counts` parts each, [sum of counts]."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _composite(fragments: _Fragments, features: np.ndarray, sums: np.ndarray, log_transmittance: np.ndarray) -> None:
    """Composite fragments behind those before; adds to sums [pixels, 5] and log_transmittance [pixels]."""
    by_pixel = np.argsort(fragments.pixel, kind="stable")  # each pixel's fragments stay nearest first
    pixel, splat, alpha = (field[by_pixel] for field in fragments)
    starts = np.concatenate([[0], np.flatnonzero(pixel[1:] != pixel[:-1]) + 1])  # [touched pixels]
    ends = np.append(starts[1:], len(pixel))
    touched = pixel[starts]

    # log T by one running sum over all pixels, in float64; each pixel's begins where the one before it ended.
    log_passed = np.log(1 - alpha)
    running = np.cumsum(log_passed.astype(np.float64))
    before = np.concatenate([[0.0], running[ends[:-1] - 1]])
    running += np.repeat(log_transmittance[touched] - before, ends - starts)
    weight = alpha * np.exp((running - log_passed).astype(np.float32))
    weight[running <= MIN_LOG_TRANSMITTANCE] = 0
    log_transmittance[touched] = running[ends - 1]

    weighted = weight * np.take(features.T, splat, axis=1)  # [4, fragments]: long rows, which are fastest in NumPy
    sums[touched, :4] += np.add.reduceat(weighted, starts, axis=1).T
    sums[touched, 4] += np.add.reduceat(weight, starts)
