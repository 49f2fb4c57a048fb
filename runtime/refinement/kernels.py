"""Projection compiled by numba, and the way back from a projected Gaussian to every parameter.

The forward arithmetic is that of `rendering` (EWA splatting, Zwicker et al. 2001, with the constants of gsplat).
"""

import numpy as np

from ..geometry.projection import EPS2D, FOV_MARGIN
from ..geometry.sh import SH_1, SH_2, SH_3
from ..rendering.rasterizer_numba import fill_rotation, fill_sh_basis
from ..rendering.types import MIN_ALPHA
from .compositing import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    ENTRY,
    LOG_MIN_ALPHA,
    OPACITY,
    RED,
    WEIGHT,
    X,
    Y,
    compiled_fast,
    end_of_entries,
)

EPSILON = 1e-15  # of Adam, as 3DGS has it


@compiled_fast
def _sh_gradient(x: float, y: float, z: float, worth: np.ndarray, gradient: np.ndarray) -> None:
    """Fill the gradient [3] of sum(worth * basis) with respect to the direction; worth: [coefficients]."""
    count = len(worth)
    gx, gy, gz = 0.0, 0.0, 0.0
    if count > 1:
        gx, gy, gz = -SH_1 * worth[3], -SH_1 * worth[1], SH_1 * worth[2]
    if count > 4:
        a, b, c = SH_2
        gx += a * y * worth[4] - 2 * b * x * worth[6] - a * z * worth[7] + 2 * c * x * worth[8]
        gy += a * x * worth[4] - a * z * worth[5] - 2 * b * y * worth[6] - 2 * c * y * worth[8]
        gz += -a * y * worth[5] + 4 * b * z * worth[6] - a * x * worth[7]
    if count > 9:
        p, q, r, s, t = SH_3
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * p * x * y * worth[9] + q * y * z * worth[10] + 2 * r * x * y * worth[11] - 6 * s * x * z * worth[12]
        gx += -r * (4 * zz - 3 * xx - yy) * worth[13] + 2 * t * x * z * worth[14] - 3 * p * (xx - yy) * worth[15]
        gy += -3 * p * (xx - yy) * worth[9] + q * x * z * worth[10] - r * (4 * zz - xx - 3 * yy) * worth[11]
        gy += (
            -6 * s * y * z * worth[12]
            + 2 * r * x * y * worth[13]
            - 2 * t * y * z * worth[14]
            + 6 * p * x * y * worth[15]
        )
        gz += q * x * y * worth[10] - 8 * r * y * z * worth[11] + s * (6 * zz - 3 * xx - 3 * yy) * worth[12]
        gz += -8 * r * x * z * worth[13] + t * (xx - yy) * worth[14]
    gradient[0], gradient[1], gradient[2] = gx, gy, gz


@compiled_fast
def project(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    logits: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    near: float,
    start: int,
    stop: int,
    projected: np.ndarray,  # [gaussians, PROJECTED] float32
    boxes: np.ndarray,  # [gaussians, 4] int32: columns from, to, rows from, to
) -> None:
    """Project the Gaussians from `start` to `stop`. One that is not seen gets an empty box."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    camera, point, rotation = np.empty(3), np.empty(3), np.empty((3, 3))
    basis = np.empty(sh.shape[1])
    for axis in range(3):
        camera[axis] = -np.sum(viewmat[:3, axis] * viewmat[:3, 3])
    for index in range(start, stop):
        boxes[index, 0], boxes[index, 1], boxes[index, 2], boxes[index, 3] = 0, 0, 0, 0
        for axis in range(3):
            point[axis] = viewmat[axis, 3]
            for other in range(3):
                point[axis] += viewmat[axis, other] * means[index, other]
        z = point[2]
        opacity = 1 / (1 + np.exp(-np.float64(logits[index])))
        if not (z > near and opacity > MIN_ALPHA):
            continue
        across, down = point[0] / z, point[1] / z
        x, y = fx * across + cx, fy * down + cy
        across = min(max(across, -cx / fx - margin_x), (width - cx) / fx + margin_x)
        down = min(max(down, -cy / fy - margin_y), (height - cy) / fy + margin_y)
        fill_rotation(quats[index], rotation)
        xx, xy, yy = EPS2D, 0.0, EPS2D
        for column in range(3):
            scale = np.exp(np.float64(log_scales[index, column]))
            half_u, half_v = 0.0, 0.0
            for row in range(3):
                along = rotation[row, column] * scale
                half_u += fx / z * (viewmat[0, row] - across * viewmat[2, row]) * along
                half_v += fy / z * (viewmat[1, row] - down * viewmat[2, row]) * along
            xx += half_u * half_u
            xy += half_u * half_v
            yy += half_v * half_v
        determinant = xx * yy - xy * xy
        reach = 2 * (np.log(opacity) - LOG_MIN_ALPHA)
        half_x, half_y = np.sqrt(reach * xx), np.sqrt(reach * yy)
        left, right = max(np.ceil(x - half_x - 0.5), 0.0), min(np.floor(x + half_x - 0.5) + 1, float(width))
        top, bottom = max(np.ceil(y - half_y - 0.5), 0.0), min(np.floor(y + half_y - 0.5) + 1, float(height))
        if not (left < right and top < bottom):
            continue
        boxes[index, 0], boxes[index, 1], boxes[index, 2], boxes[index, 3] = (
            int(left),
            int(right),
            int(top),
            int(bottom),
        )
        out = projected[index]
        out[X], out[Y], out[OPACITY], out[DEPTH] = x, y, opacity, z
        out[CONIC_XX], out[CONIC_XY], out[CONIC_YY] = yy / determinant, -xy / determinant, xx / determinant
        dx, dy, dz = means[index, 0] - camera[0], means[index, 1] - camera[1], means[index, 2] - camera[2]
        length = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
        fill_sh_basis(dx / length, dy / length, dz / length, basis)
        for channel in range(3):
            colour = 0.5
            for coefficient in range(len(basis)):
                colour += basis[coefficient] * sh[index, coefficient, channel]
            out[RED + channel] = max(colour, 0.0)


@compiled_fast
def _gaussian_gradient(
    mean: np.ndarray,
    quat: np.ndarray,
    log_scale: np.ndarray,
    sh: np.ndarray,
    values: np.ndarray,
    given: np.ndarray,  # [ENTRY] float64
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    camera: np.ndarray,
    work: np.ndarray,  # [6, 3, 3]
    basis: np.ndarray,  # [2, coefficients]
    out: np.ndarray,  # [11 + 3 * coefficients]: mean, quat, log scale, logit, SH coefficients
) -> None:
    """Fill the gradients of one Gaussian's parameters from those of its projection."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    rotation, axes, for_axes = work[0], work[1], work[2]
    rows, halves, scales = work[3], work[4], work[5, 0]
    px, py, z = viewmat[0, 3], viewmat[1, 3], viewmat[2, 3]
    for axis in range(3):
        px += viewmat[0, axis] * mean[axis]
        py += viewmat[1, axis] * mean[axis]
        z += viewmat[2, axis] * mean[axis]
    lowest_x, highest_x = -cx / fx - margin_x, (width - cx) / fx + margin_x
    lowest_y, highest_y = -cy / fy - margin_y, (height - cy) / fy + margin_y
    across, down = min(max(px / z, lowest_x), highest_x), min(max(py / z, lowest_y), highest_y)
    length = fill_rotation(quat, rotation)
    for row in range(3):
        rows[0, row] = fx / z * (viewmat[0, row] - across * viewmat[2, row])
        rows[1, row] = fy / z * (viewmat[1, row] - down * viewmat[2, row])
    for column in range(3):
        scales[column] = np.exp(np.float64(log_scale[column]))
        halves[0, column], halves[1, column] = 0.0, 0.0
        for row in range(3):
            axes[row, column] = rotation[row, column] * scales[column]
            halves[0, column] += rows[0, row] * axes[row, column]
            halves[1, column] += rows[1, row] * axes[row, column]
    # The inverse M of the covariance S: dL/dS = -M (dL/dM) M.
    a, b, c = np.float64(values[CONIC_XX]), np.float64(values[CONIC_XY]), np.float64(values[CONIC_YY])
    ga, gb, gc = given[CONIC_XX], given[CONIC_XY], given[CONIC_YY]
    for_xx = -(a * a * ga + a * b * gb + b * b * gc)
    for_xy = -2 * (a * b * ga + (a * c + b * b) * gb / 2 + b * c * gc)
    for_yy = -(b * b * ga + b * c * gb + c * c * gc)
    for_px, for_py, for_z = given[X] * fx / z, given[Y] * fy / z, 0.0
    for_z -= (given[X] * fx * px + given[Y] * fy * py) / (z * z)
    for_across, for_down = 0.0, 0.0
    for row in range(3):
        for_u, for_v = 0.0, 0.0
        for column in range(3):
            half_u, half_v = halves[0, column], halves[1, column]
            for_half_u, for_half_v = 2 * for_xx * half_u + for_xy * half_v, 2 * for_yy * half_v + for_xy * half_u
            for_axes[row, column] = rows[0, row] * for_half_u + rows[1, row] * for_half_v
            for_u += axes[row, column] * for_half_u
            for_v += axes[row, column] * for_half_v
        for_z -= (rows[0, row] * for_u + rows[1, row] * for_v) / z
        for_across -= fx / z * viewmat[2, row] * for_u
        for_down -= fy / z * viewmat[2, row] * for_v
    if lowest_x < px / z < highest_x:
        for_px += for_across / z
        for_z -= for_across * px / (z * z)
    if lowest_y < py / z < highest_y:
        for_py += for_down / z
        for_z -= for_down * py / (z * z)
    for axis in range(3):
        out[axis] = viewmat[0, axis] * for_px + viewmat[1, axis] * for_py + viewmat[2, axis] * for_z
    for column in range(3):
        total = 0.0
        for row in range(3):
            total += axes[row, column] * for_axes[row, column]
        out[7 + column] = total
        for row in range(3):
            for_axes[row, column] *= scales[column]
    g = for_axes
    w, x, y, q = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + q * (g[1, 0] - g[0, 1]))
    gx = 2 * (
        -2 * x * (g[1, 1] + g[2, 2]) + y * (g[0, 1] + g[1, 0]) + q * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2])
    )
    gy = 2 * (x * (g[0, 1] + g[1, 0]) - 2 * y * (g[0, 0] + g[2, 2]) + q * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]))
    gz = 2 * (x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * q * (g[0, 0] + g[1, 1]) + w * (g[1, 0] - g[0, 1]))
    along = w * gw + x * gx + y * gy + q * gz
    out[3], out[4] = (gw - w * along) / length, (gx - x * along) / length
    out[5], out[6] = (gy - y * along) / length, (gz - q * along) / length
    opacity = np.float64(values[OPACITY])
    out[10] = given[OPACITY] * opacity * (1 - opacity)
    dx, dy, dz = mean[0] - camera[0], mean[1] - camera[1], mean[2] - camera[2]
    distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    coefficients = len(sh)
    fill_sh_basis(dx, dy, dz, basis[0])
    for coefficient in range(coefficients):
        basis[1, coefficient] = 0.0
    for channel in range(3):
        for_colour = given[RED + channel] if values[RED + channel] > 0 else 0.0
        for coefficient in range(coefficients):
            out[11 + 3 * coefficient + channel] = basis[0, coefficient] * for_colour
            basis[1, coefficient] += sh[coefficient, channel] * for_colour
    if coefficients > 1:
        turn = rows[2]
        _sh_gradient(dx, dy, dz, basis[1], turn)
        radial = dx * turn[0] + dy * turn[1] + dz * turn[2]
        out[0] += (turn[0] - dx * radial) / distance
        out[1] += (turn[1] - dy * radial) / distance
        out[2] += (turn[2] - dz * radial) / distance


@compiled_fast
def _sum_entries(index: int, boxes: np.ndarray, offsets: np.ndarray, gradients: np.ndarray, total: np.ndarray) -> None:
    total[:] = 0.0
    for entry in range(offsets[index], end_of_entries(index, boxes, offsets)):
        for column in range(ENTRY):
            total[column] += gradients[entry, column]


@compiled_fast
def parameter_gradients(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    start: int,
    stop: int,
    projected: np.ndarray,
    boxes: np.ndarray,
    offsets: np.ndarray,
    gradients: np.ndarray,
    out: np.ndarray,  # [gaussians, 11 + 3 * coefficients]
) -> None:
    """Fill the gradients of the parameters of the Gaussians from `start` to `stop`; zero for those not seen."""
    camera, work, given = np.empty(3), np.empty((6, 3, 3)), np.empty(ENTRY)
    basis = np.empty((2, sh.shape[1]))
    for axis in range(3):
        camera[axis] = -np.sum(viewmat[:3, axis] * viewmat[:3, 3])
    for index in range(start, stop):
        if boxes[index, 3] <= boxes[index, 2]:
            out[index] = 0.0
            continue
        _sum_entries(index, boxes, offsets, gradients, given)
        _gaussian_gradient(
            means[index], quats[index], log_scales[index], sh[index], projected[index], given,
            viewmat, K, width, height, camera, work, basis, out[index],
        )  # fmt: skip


@compiled_fast
def pose_gradient(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    start: int,
    stop: int,
    projected: np.ndarray,
    boxes: np.ndarray,
    offsets: np.ndarray,
    gradients: np.ndarray,
    out: np.ndarray,  # [6]
) -> None:
    """Fill the gradient of the view's pose over the Gaussians from `start` to `stop`.

    out: of a rotation vector of the world about the camera's centre, then of a translation of the world. Moving the
    camera is moving all Gaussians the other way. Their SH turn with the world, so that the rotation changes no colour:
    what the means' gradients have of it, d x dL/dd of the viewing direction d, is taken away.
    """
    camera, work, given = np.empty(3), np.zeros((6, 3, 3)), np.empty(ENTRY)
    basis, gradient = np.empty((2, sh.shape[1])), np.empty(11 + 3 * sh.shape[1])
    for axis in range(3):
        camera[axis] = -np.sum(viewmat[:3, axis] * viewmat[:3, 3])
    out[:] = 0.0
    for index in range(start, stop):
        if boxes[index, 3] <= boxes[index, 2]:
            continue
        _sum_entries(index, boxes, offsets, gradients, given)
        _gaussian_gradient(
            means[index], quats[index], log_scales[index], sh[index], projected[index], given,
            viewmat, K, width, height, camera, work, basis, gradient,
        )  # fmt: skip
        arm, turn = means[index] - camera, work[3, 2]
        distance = max(np.sqrt(np.sum(arm * arm)), 1e-12)
        w, imaginary, for_imaginary = quats[index, 0], quats[index, 1:], gradient[4:7]
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            torque = arm[i] * gradient[j] - arm[j] * gradient[i]
            if sh.shape[1] > 1:
                torque -= (arm[i] * turn[j] - arm[j] * turn[i]) / distance
            # A rotation by a small vector a adds (0, a / 2) q to a quaternion q.
            spin = w * for_imaginary[axis] - imaginary[axis] * gradient[3]
            spin += imaginary[i] * for_imaginary[j] - imaginary[j] * for_imaginary[i]
            out[axis] += torque + spin / 2
            out[3 + axis] += gradient[axis]


@compiled_fast
def _adam_direction(gradient: np.ndarray, moments: np.ndarray, beta_1: float, beta_2: float, correction: float) -> None:
    """Update a Gaussian's moments [2, columns], and replace its gradient by their quotient, all float32."""
    first, second = moments[0], moments[1]
    keep_1, add_1 = np.float32(beta_1), np.float32(1 - beta_1)
    keep_2, add_2 = np.float32(beta_2), np.float32(1 - beta_2)
    for column in range(len(gradient)):
        g = gradient[column]
        first[column] = keep_1 * first[column] + add_1 * g
        second[column] = keep_2 * second[column] + add_2 * g * g
        gradient[column] = first[column] / (np.sqrt(second[column] * np.float32(correction)) + np.float32(EPSILON))


@compiled_fast
def _center_sh_gradient(basis: np.ndarray, mean_basis: np.ndarray, gradient: np.ndarray) -> None:
    """Make the gradient of SH of degree 1 that about the mean direction, or 0 if that is 0.

    basis: at the direction, [coefficients]. mean_basis: at the mean direction, up to degree 1.
    """
    some = len(mean_basis) > 1 and (mean_basis[1] != 0.0 or mean_basis[2] != 0.0 or mean_basis[3] != 0.0)
    for coefficient in range(1, len(mean_basis)):
        aside = (basis[coefficient] - mean_basis[coefficient]) / basis[0] if some else 0.0
        for channel in range(3):
            gradient[11 + 3 * coefficient + channel] = aside * gradient[11 + channel]


@compiled_fast
def adam_step(
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    logits: np.ndarray,
    sh: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    start: int,
    stop: int,
    projected: np.ndarray,
    boxes: np.ndarray,
    offsets: np.ndarray,
    gradients: np.ndarray,
    moments: np.ndarray,  # [gaussians, 2, 11 + 3 * coefficients] float32
    lr: np.ndarray,  # [11 + 3 * coefficients] float32, over the bias correction of the first moments
    beta_1: float,
    beta_2: float,
    correction: float,  # one over the bias correction of the second moments
    opacity_decay: float,
    scale_growth: float,
    directions: np.ndarray,  # [gaussians, 3]: the mean direction to each, or 0
) -> None:
    """One step of Adam on the Gaussians that this view sees (selective Adam); no gradient is stored.

    With d the direction and m its mean, a colour is, up to SH of degree 1, a + b (d - m). Adam optimises a and b, and
    so the SH of degree 0 change with b, too. Else b would take part in what is the same from everywhere, and hardly
    follow the direction where directions spread little. Where m is 0, b stays as it is.

    opacity_decay: times the gradient of the opacity, is subtracted from its logit. scale_growth: is added to the log
    scales. Both are outside of Adam, as in AdamW (Loshchilov and Hutter 2019).
    """
    camera, work, given = np.empty(3), np.empty((6, 3, 3)), np.empty(ENTRY)
    basis, mean_basis = np.empty((2, sh.shape[1])), np.empty(min(sh.shape[1], 4))
    gradient = np.empty(11 + 3 * sh.shape[1], np.float32)
    for axis in range(3):
        camera[axis] = -np.sum(viewmat[:3, axis] * viewmat[:3, 3])
    for index in range(start, stop):
        if boxes[index, 3] <= boxes[index, 2]:
            continue
        _sum_entries(index, boxes, offsets, gradients, given)
        if given[WEIGHT] == 0.0:
            continue
        _gaussian_gradient(
            means[index], quats[index], log_scales[index], sh[index], projected[index], given,
            viewmat, K, width, height, camera, work, basis, gradient,
        )  # fmt: skip
        fill_sh_basis(directions[index, 0], directions[index, 1], directions[index, 2], mean_basis)
        _center_sh_gradient(basis[0], mean_basis, gradient)
        _adam_direction(gradient, moments[index], beta_1, beta_2, correction)
        for axis in range(3):
            means[index, axis] -= lr[axis] * gradient[axis]
            log_scales[index, axis] -= lr[7 + axis] * gradient[7 + axis] - scale_growth
        for axis in range(4):
            quats[index, axis] -= lr[3 + axis] * gradient[3 + axis]
        opacity = np.float64(projected[index, OPACITY])
        logits[index] -= lr[10] * gradient[10] + opacity_decay * opacity * (1.0 - opacity)
        for coefficient in range(sh.shape[1]):
            for channel in range(3):
                column = 11 + 3 * coefficient + channel
                change = lr[column] * gradient[column]
                sh[index, coefficient, channel] -= change
                if 0 < coefficient < len(mean_basis):
                    sh[index, 0, channel] += change * mean_basis[coefficient] / mean_basis[0]
