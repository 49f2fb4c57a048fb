"""Colours fitted to the images by rendering: what a view's render lacks is led back to the Gaussians that it shows.

Where Gaussians of several views mix in a pixel, their own colours give a blurred image. Means, scales, quats and
opacities stay as they are, so that the images are linear in the SH, and a few rounds of simultaneous iterative
reconstruction (SIRT, Gilbert 1972) find those. In each round all views are rendered. Let w_v be the weight of a
Gaussian in view v, the sum of alpha T over the pixels; r_v the mean residual, image minus render, that it has there,
weighted by alpha T; d_v the unit direction from the camera to it; and m the mean of these, weighted by w_v. Its colour
changes by RELAXATION (a + b (d - m)), which minimises, for each channel,

    LEAST_WEIGHT a^2 + sum_v w_v ((a + b (d_v - m) - r_v)^2 + s |b|^2)

The SH of degree 1 then follow highlights and reflections, which differ from view to view. The price s on them is
STIFFNESS, or less where the views' directions spread little (`directions`): SPREAD_STIFFNESS times the square of the
spread, over the number of views, as more of them say more about b.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..geometry.rigid import invert_rigid
from ..geometry.sh import SH_0, SH_1, sh_basis
from ..splats.gaussians import Gaussians
from ..system.progress import progress
from .directions import view_directions
from .rasterizer import GradientRasterizer, compile_all
from .refine import PosedImage, as_parameters, covered

ROUNDS = 4
RELAXATION = 1.4  # of a change; below 2, the rounds converge
STIFFNESS = 0.015  # directions differ by some tenths
SPREAD_STIFFNESS = 0.9
LEAST_WEIGHT = 0.1  # pixels: a Gaussian that is hidden in all views keeps its colour
SEEN = 1e-6  # pixels: the least weight, so that the equations of what no view shows have a solution
LINEAR = 4  # coefficients of SH up to degree 1
BLOCK = 1 << 17  # Gaussians whose equations are solved at once


def fit_colors(gaussians: Gaussians, views: Sequence[PosedImage]) -> Gaussians:
    """The Gaussians with SH of degrees 0 and 1 with which their renders are closer to the images of the views.

    Gaussians with SH of degree 0 get a alone; degrees above 1 stay as they are. Pixels that the Gaussians do not cover
    count for nothing.
    """
    compile_all()
    parameters = as_parameters(gaussians, gaussians.opacities, gaussians.scales)
    rasterizer = GradientRasterizer(parameters)
    unknowns = min(LINEAR, gaussians.sh.shape[1])
    spread = view_directions(parameters.means, [view.target for view in views]).spread
    stiffness = min(STIFFNESS, SPREAD_STIFFNESS * spread**2 / len(views))
    for turn in range(1, ROUNDS + 1):
        normal, right = _equations(rasterizer, views, unknowns, f"fitting colours, {turn} of {ROUNDS}")
        for start in range(0, len(gaussians), BLOCK):
            part = slice(start, start + BLOCK)
            parameters.sh[part, :unknowns] += RELAXATION * _sh_change(normal[part], right[part], stiffness)
    return replace(gaussians, sh=parameters.sh)


def _equations(
    rasterizer: GradientRasterizer, views: Sequence[PosedImage], unknowns: int, title: str
) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations of the SH of all Gaussians without what keeps a and b small, from a render of each view.

    Returns float32 [gaussians, unknowns, unknowns] and [gaussians, unknowns, 3].
    """
    means = rasterizer.parameters.means
    normal = np.zeros((len(means), unknowns, unknowns), np.float32)
    right = np.zeros((len(means), unknowns, 3), np.float32)
    for view in progress(views, title):
        done = rasterizer.forward(view.target)
        residual = (view.image - done.rgb) * covered(view, done).weights
        sums = rasterizer.color_sums(done, rasterizer.backward(done, residual))
        seen = np.flatnonzero(sums[:, 3])
        rays = means[seen] - invert_rigid(view.viewmat)[:3, 3].astype(np.float32)
        basis = sh_basis(rays / np.linalg.norm(rays, axis=1, keepdims=True), unknowns)
        normal[seen] += sums[seen, 3, None, None] * basis[:, :, None] * basis[:, None]
        right[seen] += basis[:, :, None] * sums[seen, None, :3]
    return normal, right


def _sh_change(normal: np.ndarray, right: np.ndarray, stiffness: float) -> np.ndarray:
    """The change of SH that the normal equations of some Gaussians give, float32 [gaussians, unknowns, 3]."""
    weight = np.maximum(normal[:, 0, 0] / SH_0**2, SEEN).astype(np.float64)
    # a is the change of SH times the basis at m, whose mean over the views the equations of degree 0 hold; b is SH_1
    # times that of the SH of degree 1.
    basis = normal[:, 0] / (SH_0 * weight[:, None])
    basis[:, 0] = SH_0
    ridge = LEAST_WEIGHT * basis[:, :, None] * basis[:, None]
    degree_1 = np.arange(1, normal.shape[1])
    ridge[:, degree_1, degree_1] += stiffness * SH_1**2 * weight[:, None]
    return np.linalg.solve(normal + ridge, right).astype(np.float32)
