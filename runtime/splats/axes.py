"""The axes of files that do not have OpenCV's, and the half turns that lead there and back."""

import numpy as np

from .gaussians import Gaussians

# Signs of x, y and z in other frames; each a half turn, which is its own inverse.
OPENGL = (1, -1, -1)  # x right, y up, z backward, as .spz has it
GLTF = (-1, -1, 1)  # x left, y up, z forward, as .glb has it

# The axes in which each spherical harmonic of degree 0 to 3 is odd: it changes sign with each of them.
ODD_IN = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")


def convert_axes(gaussians: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    """The same Gaussians seen in another frame: means, rotations and spherical harmonics turned."""
    sign = dict(zip("xyz", signs, strict=True))
    odd = [np.prod([sign[axis] for axis in axes]) for axes in ODD_IN[: gaussians.sh.shape[1]]]
    return Gaussians(
        means=gaussians.means * np.array(signs, np.float32),
        scales=gaussians.scales,
        # The axis of each rotation turns; that the ellipsoid's own axes turn, too, changes nothing about it.
        quats=gaussians.quats * np.array([1, *signs], np.float32),
        opacities=gaussians.opacities,
        sh=gaussians.sh * np.array(odd, np.float32)[:, None],
    )
