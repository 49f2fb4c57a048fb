"""PM-Loss: Gaussians against a pointmap, the 3D points that another source gives for the pixels of the context views.

Shi et al. 2025, "Revisiting Depth Representations for Feed-Forward 3D Gaussian Splatting". The pointmap has a frame and
a scale of its own. A similarity aligns it with the means (Umeyama 1991), pixel by pixel, and

    L_PM = mean over means mu of min_p' |mu - p'|^2,    p' the aligned points,

so a mean between two surfaces is pulled to the nearer one instead of to the point of its own pixel.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from ....model.common.geometry import Cameras, unproject
from ..data.samples import TrainingViews

# Points that a similarity is determined by.
MIN_POINTS = 3


def pointmap_loss(means: Tensor, pointmap: Tensor) -> Tensor:
    """L_PM in scene units^2, a scalar; 0 where fewer than MIN_POINTS points are known.

    means: [gaussians, 3]. pointmap: the point of each Gaussian's pixel, NaN where it is unknown, [gaussians, 3]. Means
    without a point are left out. The alignment and the choice of the nearest point have no gradient.
    """
    known = torch.isfinite(pointmap).all(dim=1)
    if int(known.sum()) < MIN_POINTS:
        return means.sum() * 0
    means = means[known]
    positions = means.detach().double().numpy()
    scale, rotation, translation = umeyama(pointmap[known].double().numpy(), positions)
    aligned = scale * pointmap[known].double().numpy() @ rotation.T + translation
    _, nearest = cKDTree(aligned).query(positions)
    return (means - torch.from_numpy(aligned[nearest]).to(means)).square().sum(dim=1).mean()


def umeyama(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale s, rotation R [3, 3] and translation t [3] that minimise the sum of |target - (s R source + t)|^2.

    source, target: corresponding points, [points, 3] each.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred, wanted = source - source_mean, target - target_mean
    rotation = Rotation.align_vectors(wanted, centred)[0].as_matrix()
    rotated = centred @ rotation.T
    scale = float((wanted * rotated).sum() / max((rotated**2).sum(), np.finfo(float).tiny))
    return scale, rotation, target_mean - scale * rotation @ source_mean


def exact_pointmap(views: TrainingViews) -> Tensor:
    """The points that the pixels of the context views show, from the true depth: [context * H * W, 3] in the world."""
    assert views.inverse_depth is not None
    cameras = Cameras(views.extrinsics, views.intrinsics, views.near, views.far)
    middle = torch.full((1, 1, 2), 0.5)
    return unproject(1 / views.inverse_depth, middle, cameras).flatten(0, 1)
