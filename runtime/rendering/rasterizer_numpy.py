"""The rasteriser's two heavy steps in NumPy: projection and compositing, the reference for the compiled ones."""

from collections.abc import Iterator
from math import log
from typing import NamedTuple

import numpy as np

from ..geometry.quaternions import quaternions_to_matrices
from ..geometry.sh import sh_basis
from .types import (
    EPS2D,
    FOV_MARGIN,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_LOG_TRANSMITTANCE,
    PROJECTED_AT_ONCE,
    Scene,
    Splats,
    View,
)


def project(gaussians: Scene, start: int, camera: View) -> Splats:
    """Those Gaussians of the block from `start` on that touch the image, as ellipses, in the order given."""
    block = Scene(*(field[start : start + PROJECTED_AT_ONCE] for field in gaussians))
    points = block.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]  # [block, 3], camera frame
    seen = _where((points[:, 2] > camera.near) & (block.opacities >= MIN_ALPHA))
    points, block = points[seen], Scene(*(field[seen] for field in block))

    splats = _ellipses(points, block, camera)
    touching = _where((splats.rows > 0) & (splats.columns > 0))
    splats = splats.select(touching)
    splats.paint[:, :3] = _colours(block.means[touching], block.sh[touching], camera.viewmat)
    splats.paint[:, 3] = points[touching, 2]
    return splats


def _where(mask: np.ndarray) -> np.ndarray | slice:
    """An index of what is True: where that is everything, one that copies nothing."""
    return slice(None) if mask.all() else np.flatnonzero(mask)


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
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    across = np.clip(across, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    down = np.clip(down, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    to_camera = camera.viewmat[:3, :3]
    jacobian_x = (fx / z)[:, None] * (to_camera[0] - across[:, None] * to_camera[2])  # [splats, 3]
    jacobian_y = (fy / z)[:, None] * (to_camera[1] - down[:, None] * to_camera[2])
    axes = quaternions_to_matrices(gaussians.quats) * gaussians.scales[:, None, :]  # [splats, 3, 3], as columns, scaled
    half_x = np.einsum("ni,nij->nj", jacobian_x, axes)
    half_y = np.einsum("ni,nij->nj", jacobian_y, axes)
    x_variance = np.einsum("ni,ni->n", half_x, half_x) + EPS2D
    y_variance = np.einsum("ni,ni->n", half_y, half_y) + EPS2D
    shear = np.einsum("ni,ni->n", half_x, half_y) / y_variance
    # Never below the dilation in exact arithmetic; the difference of two large numbers may be.
    row_variance = np.maximum(x_variance - shear * shear * y_variance, EPS2D)

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
    basis = sh_basis(directions.astype(np.float32), sh.shape[1])
    return np.maximum(np.einsum("nk,nkc->nc", basis, sh) + np.float32(0.5), 0)


def composite_band(splats: Splats, top: int, rows: int, width: int) -> np.ndarray:
    """Sums [rows, width, 5] of red, green, blue, depth and alpha over the image rows from `top` on."""
    last_row = splats.first_row + splats.rows
    splats = splats.select(np.flatnonzero((splats.first_row < top + rows) & (last_row > top)))
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
        yield splats.select(slice(start, stop))
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


FRAGMENTS_AT_ONCE = 1 << 18  # likewise
