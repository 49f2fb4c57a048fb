"""Axis conventions of splat files that differ from OpenCV's (x right, y down, z forward), and the conversion."""

import numpy as np

from ..geometry.sh import sh_axis_signs
from .gaussians import Gaussians

# Signs of x, y and z relative to OpenCV's axes. Each is a rotation by 180 degrees, which is its own inverse.
OPENGL = (1, -1, -1)  # x right, y up, z backward: .spz
GLTF = (-1, -1, 1)  # x left, y up, z forward: .glb


def convert_axes(gaussians: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    """The Gaussians in a frame whose axes are multiplied by `signs`, two of them -1; applied twice, the identity.

    The rotation R of a Gaussian becomes D R D with D = diag(signs): its quaternion (w, v) becomes (w, D v). The factor
    D on the right changes the signs of the Gaussian's own axes, which its covariance does not depend on.
    """
    return Gaussians(
        means=gaussians.means * np.array(signs, np.float32),
        scales=gaussians.scales,
        quats=gaussians.quats * np.array([1, *signs], np.float32),
        opacities=gaussians.opacities,
        sh=gaussians.sh * sh_axis_signs(signs, gaussians.sh.shape[1])[:, None],
    )
