"""Merging of Gaussians that different views predict at the same point of a surface."""

from dataclasses import fields

import numpy as np

from ..geometry.consistency import project_to_view
from ..geometry.quaternions import matrices_to_quaternions, quaternions_to_matrices
from .gaussians import Gaussians

DEPTH_TOLERANCE = 0.01  # fraction of the depth by which duplicates may differ
MAX_OPACITY = 1 - 1e-6  # log(1 - opacity) must be finite


def find_duplicates(
    means: np.ndarray, depth: np.ndarray, kept: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """The index of the Gaussian that represents each one, [views, height, width]: an earlier view's, or its own.

    A Gaussian is a duplicate of an earlier view's if its mean projects to that pixel, within DEPTH_TOLERANCE of the
    depth there. means: [views, height, width, 3]. kept: a mask of the Gaussians that take part, [views, height, width].
    """
    views, height, width = depth.shape
    representative = np.arange(depth.size).reshape(views, height * width)
    kept = kept.reshape(views, height * width)
    for view in range(1, views):
        single = np.flatnonzero(kept[view])
        for earlier in range(view):
            points = means[view].reshape(-1, 3)[single]
            pixel, z, seen = project_to_view(points, (height, width), extrinsics[earlier], intrinsics[earlier])
            surface = depth[earlier].ravel()[pixel]
            same = seen & kept[earlier][pixel] & (np.abs(z - surface) <= DEPTH_TOLERANCE * surface)
            representative[view, single[same]] = representative[earlier, pixel[same]]
            single = single[~same]
    return representative.reshape(views, height, width)


def merge_gaussians(gaussians: Gaussians, representative: np.ndarray) -> Gaussians:
    """The Gaussians, with each representative of a group replaced by the moment match of its group.

    With weights w_i proportional to opacity: mean = sum w_i mean_i, covariance = sum w_i (Sigma_i + (mean_i - mean)
    (mean_i - mean)^T), sh = sum w_i sh_i, and opacity = 1 - prod (1 - opacity_i).
    """
    groups, place = np.unique(representative.ravel(), return_inverse=True)
    counts = np.bincount(place)
    several = counts > 1
    chosen = groups[several]
    if not len(chosen):
        return gaussians
    members = np.flatnonzero(several[place])
    group = (np.cumsum(several) - 1)[place[members]]
    weight = np.maximum(gaussians.opacities[members], 1 - MAX_OPACITY).astype(np.float64)
    weight /= np.bincount(group, weight)[group]

    def total(values: np.ndarray) -> np.ndarray:
        """Sums of values [members, ...] over each group, [groups, ...]."""
        columns = values.reshape(len(members), -1)
        sums = [np.bincount(group, column, len(chosen)) for column in columns.T]
        return np.stack(sums, axis=1).reshape(len(chosen), *values.shape[1:])

    mean = total(weight[:, None] * gaussians.means[members])
    offset = gaussians.means[members] - mean[group]
    covariance = covariances(gaussians, members) + offset[:, :, None] * offset[:, None, :]
    scales, quats = ellipsoids(total(weight[:, None, None] * covariance))
    log_transmittance = total(
        np.log1p(-np.minimum(gaussians.opacities[members], MAX_OPACITY).astype(np.float64))[:, None]
    )
    new = {
        "means": mean,
        "scales": scales,
        "quats": quats,
        "opacities": 1 - np.exp(log_transmittance[:, 0]),
        "sh": total(weight[:, None, None] * gaussians.sh[members]),
    }
    arrays = {field.name: getattr(gaussians, field.name).copy() for field in fields(gaussians)}
    for name, values in new.items():
        arrays[name][chosen] = values
    return Gaussians(**arrays)


def covariances(gaussians: Gaussians, members: np.ndarray) -> np.ndarray:
    """Covariances R S S^T R^T [members, 3, 3] of some of the Gaussians."""
    axes = quaternions_to_matrices(gaussians.quats[members]) * gaussians.scales[members][:, None, :]
    return axes @ axes.swapaxes(1, 2)


def ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales [n, 3] and quaternions wxyz [n, 4] of covariances [n, 3, 3], by eigendecomposition."""
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection: determinant 1
    return np.sqrt(np.maximum(variances, 0)), matrices_to_quaternions(axes)
