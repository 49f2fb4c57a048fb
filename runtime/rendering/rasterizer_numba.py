"""The rasteriser's two expensive steps compiled by numba, one splat after another.

They repeat the arithmetic of `rasterizer_numpy`, `geometry.projection` and `geometry.sh`, in the same order of
operations but for the exp of alpha, which comes from a table, and take the constants from there.
"""

from math import ceil, exp, log

import numpy as np

from ..geometry.projection import DISC_STD, EPS2D, FOV_MARGIN
from ..geometry.sh import SH_0, SH_1, SH_2, SH_3
from ..system.compilation import compiled, compiling
from .types import BLOCK_SIZE, MAX_ALPHA, MIN_ALPHA, MIN_LOG_TRANSMITTANCE, SPLAT, GaussianArrays, View

# Alpha is float32, as in NumPy's version: at a limit both must decide alike.
MIN_ALPHA_32, MAX_ALPHA_32 = np.float32(MIN_ALPHA), np.float32(MAX_ALPHA)
LOG_MIN_ALPHA = log(MIN_ALPHA)
LOG_MIN_ALPHA_32 = np.float32(LOG_MIN_ALPHA)
# exp at multiples of -1 / EXP_STEPS, down to MIN_ALPHA: what `_exp_of_falloff` starts from.
EXP_STEPS = 16
EXP_TABLE = np.exp(-np.arange(ceil(-LOG_MIN_ALPHA * EXP_STEPS) + 1) / EXP_STEPS).astype(np.float32)
MIN_TRANSMITTANCE = exp(MIN_LOG_TRANSMITTANCE)
ENDED = 0.0  # stands for the transmittance of a pixel that takes no further fragments

_compiled = compiled(fastmath={"contract"})


def compile_all() -> None:
    """Compile what is not yet, by rendering one Gaussian."""
    arrays = (np.array([[0, 0, 1]]), np.ones((1, 4)), np.ones((1, 3)), np.ones(1), np.zeros((1, 1, 3)))
    gaussian = GaussianArrays(*(array.astype(np.float32) for array in arrays))
    with compiling(fill_rotation, "the rasteriser"):
        splats = np.zeros(1, SPLAT)
        project(gaussian, 0, View(np.eye(4), np.eye(3), 1, 1, 0.01, 0.0, 1.0), splats)
        composite_band(splats, 0, 1, 1)


def project(gaussians: GaussianArrays, start: int, view: View, splats: np.ndarray) -> None:
    """Fill the splats of the block of Gaussians from `start` on; splats: SPLAT [gaussians], zeros."""
    block = GaussianArrays(*(field[start : start + BLOCK_SIZE] for field in gaussians))
    _project(*(*block, *view), splats[start : start + BLOCK_SIZE])  # as one: mypy confuses two of different lengths


def composite_band(splats: np.ndarray, top: int, rows: int, width: int) -> np.ndarray:
    """Composited sums [rows, width, 5] of red, green, blue, depth and alpha, for the image rows from `top` on."""
    sums = np.zeros((rows, width, 5), np.float32)
    _composite_band(splats, top, sums)
    return sums


@_compiled
def _project(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    near: float,
    aperture: float,
    focus: float,
    splats: np.ndarray,  # SPLAT [gaussians], zeros
) -> None:
    """Fill the splats of the Gaussians that touch the image."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    position = np.empty(3)
    for axis in range(3):
        position[axis] = -np.sum(viewmat[:3, axis] * viewmat[:3, 3])
    point, rotation = np.empty(3), np.empty((3, 3))
    basis = np.empty(sh.shape[1], np.float32)
    for index in range(len(means)):
        for axis in range(3):
            point[axis] = viewmat[axis, 3]
            for other in range(3):
                point[axis] += viewmat[axis, other] * means[index, other]
        z = point[2]
        if not (z > near and opacities[index] >= MIN_ALPHA_32):
            continue
        slope_x, slope_y = point[0] / z, point[1] / z
        x, y = fx * slope_x + cx, fy * slope_y + cy
        slope_x = min(max(slope_x, -cx / fx - margin_x), (width - cx) / fx + margin_x)
        slope_y = min(max(slope_y, -cy / fy - margin_y), (height - cy) / fy + margin_y)
        fill_rotation(quats[index], rotation)
        xx, xy, yy = 0.0, 0.0, 0.0
        for column in range(3):
            half_x, half_y = 0.0, 0.0
            for row in range(3):
                along = rotation[row, column] * scales[index, column]
                half_x += fx / z * (viewmat[0, row] - slope_x * viewmat[2, row]) * along
                half_y += fy / z * (viewmat[1, row] - slope_y * viewmat[2, row]) * along
            xx += half_x * half_x
            xy += half_x * half_y
            yy += half_y * half_y
        xx, yy = xx + EPS2D, yy + EPS2D
        blur = DISC_STD * aperture * (1 / focus - 1 / z)
        x_variance, y_variance = xx + (fx * blur) ** 2, yy + (fy * blur) ** 2
        _, focused_row_variance = _shear_rows(xx, xy, yy)
        shear, row_variance = _shear_rows(x_variance, xy, y_variance)
        reach = np.log(np.float64(opacities[index] / MIN_ALPHA_32))
        first_row, rows = _span(y, np.sqrt(2 * reach * y_variance), height)
        _, columns = _span(x, np.sqrt(2 * reach * x_variance), width)
        if rows == 0 or columns == 0:
            continue
        splat = splats[index]
        splat.x, splat.y, splat.shear = x, y, shear
        splat.row_variance, splat.y_variance, splat.reach = row_variance, y_variance, reach
        splat.opacity_scale = np.sqrt(min(focused_row_variance / row_variance * (yy / y_variance), 1.0))
        splat.first_row, splat.rows, splat.columns = first_row, rows, columns
        _fill_basis(means[index], position, basis)
        for channel in range(3):
            colour = np.float32(0.5)
            for coefficient in range(len(basis)):
                colour += basis[coefficient] * sh[index, coefficient, channel]
            splat.features[channel] = max(colour, np.float32(0))
        splat.features[3] = z


@_compiled
def _shear_rows(xx: float, xy: float, yy: float) -> tuple[float, float]:
    """shear and row_variance of a covariance, as in `SPLAT`."""
    shear = xy / yy
    return shear, max(xx - shear * shear * yy, EPS2D)


@_compiled
def fill_rotation(quat: np.ndarray, rotation: np.ndarray) -> float:
    """Fill the rotation matrix [3, 3] of a wxyz quaternion of any length, and return that; zero means no rotation."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = max(np.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return norm


@_compiled
def _span(centre: float, half: float, size: int) -> tuple[int, int]:
    """The first pixel whose centre lies within centre +- half, and their number, along a side of `size` pixels."""
    first = min(max(np.ceil(centre - half - 0.5), 0.0), float(size))
    last = min(max(np.floor(centre + half - 0.5), -1.0), size - 1.0)
    return int(first), max(int(last - first + 1), 0)


@_compiled
def _fill_basis(mean: np.ndarray, position: np.ndarray, basis: np.ndarray) -> None:
    """Fill the SH basis functions [coefficients] in the direction from `position` to `mean`."""
    basis[0] = SH_0
    if len(basis) == 1:
        return
    x, y, z = mean[0] - position[0], mean[1] - position[1], mean[2] - position[2]
    norm = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    fill_sh_basis(x / norm, y / norm, z / norm, basis)


@_compiled
def fill_sh_basis(x: float, y: float, z: float, basis: np.ndarray) -> None:
    """Fill the SH basis functions [coefficients] at a unit direction."""
    basis[0] = SH_0
    if len(basis) == 1:
        return
    basis[1], basis[2], basis[3] = -SH_1 * y, SH_1 * z, -SH_1 * x
    if len(basis) == 4:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4], basis[5] = SH_2[0] * x * y, -SH_2[0] * y * z
    basis[6] = SH_2[1] * (2 * zz - xx - yy)
    basis[7], basis[8] = -SH_2[0] * x * z, SH_2[2] * (xx - yy)
    if len(basis) == 9:
        return
    basis[9], basis[10] = -SH_3[0] * y * (3 * xx - yy), SH_3[1] * x * y * z
    basis[11] = -SH_3[2] * y * (4 * zz - xx - yy)
    basis[12] = SH_3[3] * z * (2 * zz - 3 * xx - 3 * yy)
    basis[13] = -SH_3[2] * x * (4 * zz - xx - yy)
    basis[14], basis[15] = SH_3[4] * z * (xx - yy), -SH_3[0] * x * (xx - 3 * yy)


@_compiled
def _exp_of_falloff(x: np.float32) -> np.float32:
    """exp(x), to 1e-7 of it, for x clipped to LOG_MIN_ALPHA to 0; faster than the library's function.

    From the nearest entry of EXP_TABLE by the Taylor series, whose next term is below 4e-8.
    """
    x = min(max(x, LOG_MIN_ALPHA_32), np.float32(0))
    entry = np.uint64(np.float32(0.5) - np.float32(EXP_STEPS) * x)
    rest = x + np.float32(entry) * np.float32(1 / EXP_STEPS)
    series = np.float32(0.5) + rest * np.float32(1 / 6)
    return EXP_TABLE[entry] * (np.float32(1) + rest * (np.float32(1) + rest * series))


@_compiled
def _composite_band(
    splats: np.ndarray,  # SPLAT [splats], nearest first
    top: int,
    sums: np.ndarray,  # [band rows, width, 5]
) -> None:
    """Composite the splats into the rows of the image from `top` on."""
    band_rows, width, _ = sums.shape
    transmittance = np.ones((band_rows, width))
    still_open = band_rows * width
    for index in range(len(splats)):
        splat = splats[index]
        first_inside, end = max(splat.first_row, top), min(splat.first_row + splat.rows, top + band_rows)
        if first_inside >= end:
            continue
        # Read once: for the compiler, what is written below could change the splats.
        centre_x, centre_y, slant = splat.x, splat.y, splat.shear
        variance, per_row, reach_peak = splat.row_variance, 0.5 / splat.y_variance, splat.reach
        scale, sharpness = np.float32(splat.opacity_scale), np.float32(np.sqrt(0.5 / variance))
        red, green, blue, depth = splat.features[0], splat.features[1], splat.features[2], splat.features[3]
        for row in range(first_inside, end):
            dy = row + 0.5 - centre_y
            reach_here = max(reach_peak - dy * dy * per_row, 0.0)
            centre = centre_x + slant * dy
            first, length = _span(centre, np.sqrt(2 * reach_here * variance), width)
            distance = np.float32(first + 0.5 - centre)
            log_peak = np.float32(reach_here + LOG_MIN_ALPHA)
            for step in range(length):
                before = transmittance[row - top, first + step]
                if before == ENDED:
                    continue
                falloff = (distance + np.float32(step)) * sharpness
                alpha = min(_exp_of_falloff(log_peak - falloff * falloff), MAX_ALPHA_32) * scale
                after = before * (np.float32(1) - alpha)
                if after <= MIN_TRANSMITTANCE:  # this fragment is skipped, too
                    transmittance[row - top, first + step] = ENDED
                    still_open -= 1
                    continue
                transmittance[row - top, first + step] = after
                weight = alpha * np.float32(before)
                sums[row - top, first + step, 0] += weight * red
                sums[row - top, first + step, 1] += weight * green
                sums[row - top, first + step, 2] += weight * blue
                sums[row - top, first + step, 3] += weight * depth
                sums[row - top, first + step, 4] += weight
        if still_open == 0:
            break
