"""Compositing compiled by numba, front to back, and its backward pass over the fragments that it recorded.

The image is divided into bands of rows. Each band has the list of Gaussians that reach it, nearest first; a Gaussian in
a band is an entry. Forward, every pixel to which an entry contributes is recorded as a fragment, with its alpha.
Backward, an entry's fragments give one row of gradients, and each Gaussian sums its entries in a fixed order: no two
threads write to one place, and the result does not depend on the number of threads.
"""

from math import log

import numpy as np

from ..rendering.types import MAX_ALPHA, MIN_ALPHA
from ..system.compilation import compiled

BAND_ROWS = 16
MIN_TRANSMITTANCE = 1e-4
LOG_MIN_ALPHA = log(MIN_ALPHA)
# Columns of a projected Gaussian.
X, Y, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
PROJECTED = 10
# Columns of an entry's gradients: those of the projected Gaussian up to BLUE, and its weight in the image.
WEIGHT = 9
ENTRY = 10
# A key of an entry: the bits of its depth, then the number of its Gaussian. Positive floats sort as their bits do.
DEPTH_SHIFT, GAUSSIAN_MASK = np.uint64(32), np.uint64(0xFFFFFFFF)

compiled_fast = compiled(fastmath={"contract", "arcp"})
# Of numbers that are known to be finite: only what `project` has let through.
compiled_finite = compiled(fastmath={"contract", "arcp", "nnan", "ninf", "nsz", "reassoc"})


@compiled_fast
def count_entries(
    boxes: np.ndarray,
    offsets: np.ndarray,  # [gaussians]: each one's first entry
    entries: np.ndarray,  # [bands], zeros: how many there are
) -> int:
    """Fill what the entries need; returns the number of all."""
    total = 0
    for index in range(len(boxes)):
        offsets[index] = total
        top, bottom = boxes[index, 2], boxes[index, 3]
        if bottom <= top:
            continue
        for band in range(top // BAND_ROWS, (bottom - 1) // BAND_ROWS + 1):
            entries[band] += 1
            total += 1
    return total


@compiled_fast
def fill_keys(boxes: np.ndarray, depth_bits: np.ndarray, starts: np.ndarray, keys: np.ndarray) -> None:
    """Fill the keys of all entries, band by band, unsorted. starts: each band's first place. depth_bits: uint64."""
    place = starts.copy()
    for index in range(len(boxes)):
        top, bottom = boxes[index, 2], boxes[index, 3]
        if bottom <= top:
            continue
        key = (depth_bits[index] << DEPTH_SHIFT) | np.uint64(index)
        for band in range(top // BAND_ROWS, (bottom - 1) // BAND_ROWS + 1):
            keys[place[band]] = key
            place[band] += 1


@compiled_finite
def _exp_of_falloff(x: np.floating) -> np.floating:
    """exp(x) for x from LOG_MIN_ALPHA to 0, to 4e-6 of it: the series of exp(x / 16) to the power of 16."""
    y = x * np.float32(1 / 16)
    series = np.float32(1 / 24) + y * (np.float32(1 / 120) + y * np.float32(1 / 720))
    series = np.float32(1 / 6) + y * series
    root = np.float32(1) + y * (np.float32(1) + y * (np.float32(0.5) + y * series))
    square = root * root
    fourth = square * square
    eighth = fourth * fourth
    return eighth * eighth


@compiled_finite
def _row_span(conic_xx: float, conic_xy: float, conic_yy: float, reach: float, dy: float) -> tuple[float, float]:
    """The distances from the centre between which alpha can reach MIN_ALPHA on a row at distance dy from it."""
    inside = conic_xy * conic_xy * dy * dy - conic_xx * (conic_yy * dy * dy - 2 * reach)
    if inside <= 0:
        return 1.0, 0.0
    half, middle = np.sqrt(inside) / conic_xx, -conic_xy * dy / conic_xx
    return middle - half, middle + half


@compiled_finite
def composite(
    keys: np.ndarray,  # [entries], sorted in each band
    start: int,
    stop: int,
    projected: np.ndarray,
    boxes: np.ndarray,
    band: int,
    fragment: int,
    image: np.ndarray,  # [height, width, 3], zeros before a band's first entry
    transmittance: np.ndarray,  # [height, width], ones before a band's first entry
    ends: np.ndarray,  # [entries]: the fragment after an entry's last one
    pixels: np.ndarray,  # [fragments] int32: row * width + column
    alphas: np.ndarray,  # [fragments]
) -> tuple[int, int]:
    """Composite the entries of a band from `start` to `stop`, and record their fragments from `fragment` on.

    A pixel is closed while its transmittance is negative. Returns where to go on: `stop` and the number of fragments,
    or before that the first entry whose fragments might not fit, and the next fragment.
    """
    height, width = transmittance.shape
    first_row, end_row = band * BAND_ROWS, min((band + 1) * BAND_ROWS, height)
    still_open = (transmittance[first_row:end_row] >= 0).sum()
    for place in range(start, stop):
        if not still_open:
            ends[place:stop] = fragment
            break
        index = np.int64(keys[place] & GAUSSIAN_MASK)
        left, right = boxes[index, 0], boxes[index, 1]
        top, bottom = max(boxes[index, 2], first_row), min(boxes[index, 3], end_row)
        if fragment + (bottom - top) * (right - left) > len(pixels):
            return place, fragment
        values = projected[index]
        x, y, opacity = values[X], values[Y], values[OPACITY]
        xx, xy, yy = values[CONIC_XX], values[CONIC_XY], values[CONIC_YY]
        red, green, blue = values[RED], values[GREEN], values[BLUE]
        reach = np.log(opacity) - np.float32(LOG_MIN_ALPHA)
        for row in range(top, bottom):
            dy = np.float32(row) + np.float32(0.5) - y
            low, high = _row_span(xx, xy, yy, reach, dy)
            # Truncation is floor here: what is below zero is left of the box.
            begin = max(int(x + low + np.float32(0.5)), left)
            end = min(int(x + high + np.float32(0.5)), right)
            for column in range(begin, end):
                before = transmittance[row, column]
                if before < 0:
                    continue
                dx = np.float32(column) + np.float32(0.5) - x
                sigma = np.float32(0.5) * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
                alpha = min(np.float32(MAX_ALPHA), opacity * _exp_of_falloff(-sigma))
                if alpha < np.float32(MIN_ALPHA):
                    continue
                after = before * (np.float32(1) - alpha)
                if after <= np.float32(MIN_TRANSMITTANCE):
                    transmittance[row, column] = -before
                    still_open -= 1
                    continue
                weight = alpha * before
                image[row, column, 0] += weight * red
                image[row, column, 1] += weight * green
                image[row, column, 2] += weight * blue
                transmittance[row, column] = after
                pixels[fragment] = row * width + column
                alphas[fragment] = alpha
                fragment += 1
        ends[place] = fragment
    for row in range(first_row, end_row):
        for column in range(width):
            transmittance[row, column] = abs(transmittance[row, column])
    return stop, fragment


@compiled_finite
def composite_backward(
    keys: np.ndarray,
    start: int,
    stop: int,
    projected: np.ndarray,
    boxes: np.ndarray,
    band: int,
    ends: np.ndarray,
    pixels: np.ndarray,
    alphas: np.ndarray,
    offsets: np.ndarray,
    image_gradient: np.ndarray,  # [height, width, 3]
    behind: np.ndarray,  # [height * width]: gradient of the transmittance times itself; overwritten
    through: np.ndarray,  # [height * width]: the transmittance; overwritten
    gradients: np.ndarray,  # [entries, ENTRY]
) -> None:
    """Write the gradients of a band's entries, back to front.

    The transmittance before a Gaussian is that behind it divided by 1 - alpha. `behind` is the part of the loss's
    derivative that comes from all behind the Gaussian at hand. With G the gradient of sigma, the exponent of alpha,
    those of centre and conic are sums of G, G dx, G dy, G dx dx and so on over the fragments.
    """
    width, zero = image_gradient.shape[1], np.float32(0)
    for place in range(stop - 1, start - 1, -1):
        index = np.int64(keys[place] & GAUSSIAN_MASK)
        values = projected[index]
        x, y = values[X], values[Y]
        red, green, blue = values[RED], values[GREEN], values[BLUE]
        for_red, for_green, for_blue, total = zero, zero, zero, zero
        sum_g, sum_x, sum_y, sum_xx, sum_xy, sum_yy = zero, zero, zero, zero, zero, zero
        for one in range(ends[place - 1] if place > start else 0, ends[place]):
            pixel, alpha = pixels[one], alphas[one]
            row = pixel // width
            column = pixel - row * width
            open_share = np.float32(1) / (np.float32(1) - alpha)
            before = through[pixel] * open_share
            weight = alpha * before
            down = image_gradient[row, column]
            for_red += weight * down[0]
            for_green += weight * down[1]
            for_blue += weight * down[2]
            total += weight
            worth = red * down[0] + green * down[1] + blue * down[2]
            g = behind[pixel] * open_share * alpha - weight * worth
            behind[pixel] += weight * worth
            through[pixel] = before
            if alpha >= np.float32(MAX_ALPHA):
                continue
            dx = np.float32(column) + np.float32(0.5) - x
            dy = np.float32(row) + np.float32(0.5) - y
            sum_g += g
            sum_x += g * dx
            sum_y += g * dy
            sum_xx += g * dx * dx
            sum_xy += g * dx * dy
            sum_yy += g * dy * dy
        xx, xy, yy = values[CONIC_XX], values[CONIC_XY], values[CONIC_YY]
        out = gradients[offsets[index] + band - boxes[index, 2] // BAND_ROWS]
        out[X], out[Y] = -(xx * sum_x + xy * sum_y), -(yy * sum_y + xy * sum_x)
        out[CONIC_XX], out[CONIC_XY], out[CONIC_YY] = np.float32(0.5) * sum_xx, sum_xy, np.float32(0.5) * sum_yy
        out[OPACITY] = -sum_g / values[OPACITY]
        out[RED], out[GREEN], out[BLUE], out[WEIGHT] = for_red, for_green, for_blue, total


@compiled_fast
def end_of_entries(index: int, boxes: np.ndarray, offsets: np.ndarray) -> int:
    """The entry after the last one of a Gaussian that is seen."""
    end: int = offsets[index] + (boxes[index, 3] - 1) // BAND_ROWS - boxes[index, 2] // BAND_ROWS + 1
    return end


@compiled_fast
def add_columns(
    boxes: np.ndarray,
    offsets: np.ndarray,
    gradients: np.ndarray,
    first: int,
    start: int,
    stop: int,
    total: np.ndarray,  # [gaussians, columns]
) -> None:
    """Add the entries' gradients from the column `first` on, of the Gaussians from `start` to `stop`, to `total`."""
    for index in range(start, stop):
        if boxes[index, 3] > boxes[index, 2]:
            for entry in range(offsets[index], end_of_entries(index, boxes, offsets)):
                for column in range(total.shape[1]):
                    total[index, column] += gradients[entry, first + column]
