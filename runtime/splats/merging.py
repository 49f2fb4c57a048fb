"""Gaussians that different views put at the same place of the same surface, made one."""

from dataclasses import fields

import numpy as np

from ..geometry.consistency import project_to_view
from ..geometry.quaternions import matrices_to_quaternions, quaternions_to_matrices
from .gaussians import Gaussians

SAME_SURFACE = 0.01  # share of the depth by which two Gaussians may differ and still be taken for one
HIGHEST_OPACITY = 1 - 1e-6  # what lets no light through has no logarithm


def duplicates(
    means: np.ndarray, depth: np.ndarray, kept: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """For each Gaussian, [views, height, width], the index of the one that stands for it: an earlier view's, or itself.

    An earlier view's does where the point falls on its pixel, at its depth.
    """
    views, height, width = depth.shape
    same_as = np.arange(depth.size).reshape(views, height * width)
    kept = kept.reshape(views, height * width)
    for view in range(1, views):
        alone = np.flatnonzero(kept[view])
        for earlier in range(view):
            points = means[view].reshape(-1, 3)[alone]
            pixel, z, seen = project_to_view(points, (height, width), extrinsics[earlier], intrinsics[earlier])
            surface = depth[earlier].ravel()[pixel]
            same = seen & kept[earlier][pixel] & (np.abs(z - surface) <= SAME_SURFACE * surface)
            same_as[view, alone[same]] = same_as[earlier, pixel[same]]
            alone = alone[~same]
    return same_as.reshape(views, height, width)


def merged(gaussians: Gaussians, same_as: np.ndarray) -> Gaussians:
    """The Gaussians with those that stand for others changed to have the mean, covariance and colour of all of them.

    Each counts as much as it is opaque, and together they let through what they would one behind the other.
    """
    groups, place = np.unique(same_as.ravel(), return_inverse=True)
    counts = np.bincount(place)
    several = counts > 1
    chosen = groups[several]
    if not len(chosen):
        return gaussians
    members = np.flatnonzero(several[place])
    group = (np.cumsum(several) - 1)[place[members]]
    weight = np.maximum(gaussians.opacities[members], 1 - HIGHEST_OPACITY).astype(np.float64)
    weight /= np.bincount(group, weight)[group]

    def total(values: np.ndarray) -> np.ndarray:
        """Sums over the members of each group of values [members, ...]."""
        columns = values.reshape(len(members), -1)
        sums = [np.bincount(group, column, len(chosen)) for column in columns.T]
        return np.stack(sums, axis=1).reshape(len(chosen), *values.shape[1:])

    mean = total(weight[:, None] * gaussians.means[members])
    off = gaussians.means[members] - mean[group]
    covariance = _covariances(gaussians, members) + off[:, :, None] * off[:, None, :]
    scales, quats = _ellipsoids(total(weight[:, None, None] * covariance))
    passed = total(np.log1p(-np.minimum(gaussians.opacities[members], HIGHEST_OPACITY).astype(np.float64))[:, None])
    new = {
        "means": mean,
        "scales": scales,
        "quats": quats,
        "opacities": 1 - np.exp(passed[:, 0]),
        "sh": total(weight[:, None, None] * gaussians.sh[members]),
    }
    arrays = {field.name: getattr(gaussians, field.name).copy() for field in fields(gaussians)}
    for name, values in new.items():
        arrays[name][chosen] = values
    return Gaussians(**arrays)


def _covariances(gaussians: Gaussians, members: np.ndarray) -> np.ndarray:
    """Covariances [members, 3, 3] of some of the Gaussians."""
    axes = quaternions_to_matrices(gaussians.quats[members]) * gaussians.scales[members][:, None, :]
    return axes @ axes.swapaxes(1, 2)


def _ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales [n, 3] and quaternions wxyz [n, 4] of covariances [n, 3, 3]."""
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    return np.sqrt(np.maximum(variances, 0)), matrices_to_quaternions(axes)
