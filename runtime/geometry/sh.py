"""Real spherical harmonics (SH) of degree 0 to 3, in the order and with the signs of 3DGS (Kerbl et al. 2023).

Colour in the unit direction d from the camera to a Gaussian is max(0.5 + sum_k Y_k(d) sh_k, 0). Coefficient k = l^2 + l
+ m belongs to degree l and order m, -l <= m <= l. The numba rasteriser repeats the basis for one splat at a time, with
the constants from here.
"""

from collections.abc import Sequence

import numpy as np

SH_0 = 0.28209479177387814  # Y of degree 0, 1 / (2 sqrt(pi))
SH_1 = 0.4886025119029199  # sqrt(3 / (4 pi))
SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)

# The axes in which each basis function is odd, which can be read off the polynomials in `sh_basis`: Y_5 ~ y z is odd in
# y and in z, Y_6 ~ 2 z^2 - x^2 - y^2 in none.
ODD_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")


def sh_basis(directions: np.ndarray, coefficients: int) -> np.ndarray:
    """Basis functions [directions, coefficients] at unit directions [directions, 3]; coefficients: 1, 4, 9 or 16."""
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


def sh_axis_signs(signs: Sequence[int], coefficients: int) -> np.ndarray:
    """Factors [coefficients] of SH coefficients when x, y and z are multiplied by `signs`, each 1 or -1.

    With D = diag(signs), the colour seen along D d in the new frame is the one along d in the old: sum_k Y_k(D d) sh'_k
    = sum_k Y_k(d) sh_k. Every Y_k is a polynomial that is odd or even in each axis, so Y_k(D d) = s_k Y_k(d), s_k being
    the product of the signs of the axes in which it is odd, and sh'_k = s_k sh_k.
    """
    sign = dict(zip("xyz", signs, strict=True))
    return np.array([np.prod([sign[axis] for axis in axes]) for axes in ODD_AXES[:coefficients]], np.float32)
