"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS (Kerbl et al. 2023)."""

import numpy as np

SH_0 = 0.28209479177387814  # the basis function of degree 0: colour is 0.5 + SH_0 * sh[:, 0]
SH_1 = 0.4886025119029199
SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: np.ndarray, coefficients: int) -> np.ndarray:
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
