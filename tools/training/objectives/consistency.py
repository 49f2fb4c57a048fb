"""Multi-view consistency: predicted depth against points that are matched between the context views.

For a point matched at pixel p of view i and q of view j, with the predicted depths D_i(p) and D_j(q):

- epipolar term: the distance in pixels between q and the projection into view j of p at depth D_i(p). Poses are known,
  so that projection lies on the epipolar line of p, and the distance measures depth.
- depth ratio: |log(D_i(p) / D_j(q)) - log(z_i / z_j)|, z_i and z_j being the depths of the triangulated point. The unit
  of the scene cancels.

Both go through r(e; c) = c log(1 + e / c) (`losses.robust_error`), since some matches are wrong.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ....runtime.sfm.features import triangulate
from ....runtime.views.matching import PointMatches, ViewMatcher
from ..data.samples import SampleSpec, SceneMatches, TrainingViews
from ..losses import robust_error

# Scales c: of distances in pixels, and of logarithms of depth ratios.
EPIPOLAR_SCALE, RATIO_SCALE = 4.0, 0.5
# Weight of the depth ratio beside the distance in pixels.
RATIO_WEIGHT = 10.0
# A depth in front of a camera, in scene units; near is 1.
MIN_DEPTH = 1e-2


def with_matches(source: Callable[[SampleSpec], TrainingViews], spec: SampleSpec) -> TrainingViews:
    """The views of a sample; with the points matched between them, if it has target views to be rendered.

    Matching takes longer than the loss, which is part of the loss of rendered views alone (`step.rendering_loss`).
    """
    views = source(spec)
    return replace(views, matches=(match_views(views),)) if spec.target_zooms else views


def match_views(views: TrainingViews) -> SceneMatches:
    """The matches of each ordered pair of a scene's context views that has any."""
    arrays = (views.images, views.extrinsics, views.intrinsics)
    images, extrinsics, intrinsics = (part.detach().cpu().numpy() for part in arrays)
    matcher = ViewMatcher(images, extrinsics.astype(np.float64), intrinsics)
    found = ((i, j, matcher.match(i, j)) for i, j in permutations(range(len(images)), 2))
    return tuple((i, j, matches) for i, j, matches in found if len(matches.first))


def consistency_loss(depth: Tensor, views: TrainingViews) -> Tensor:
    """Mean of both terms over a scene's matches of all pairs of context views; its mean over scenes.

    A scene without matches whose points are in front of both cameras has 0.

    depth: predicted z-depth of the context views, [context, H, W]. views: with their matches.
    """
    assert views.matches is not None
    context = len(depth) // views.scenes
    Ks = views.intrinsics
    total = depth.sum() * 0
    for scene, of_scene in enumerate(views.matches):
        first = scene * context
        losses = [
            matched_loss(depth[first + i], depth[first + j], Ks[first + i], Ks[first + j], matches)
            for i, j, matches in of_scene
        ]
        if any(len(of_pair) for of_pair in losses):
            total = total + torch.cat(losses).mean()
    return total / views.scenes


def matched_loss(
    first_depth: Tensor, second_depth: Tensor, first_K: Tensor, second_K: Tensor, matches: PointMatches
) -> Tensor:
    """The loss of each match whose triangulated point lies in front of both cameras, [points].

    first_depth, second_depth: predicted z-depth, [H, W]. first_K, second_K: normalised intrinsics, [3, 3].
    """
    height, width = second_depth.shape
    points = triangulate(matches.first, matches.second, matches.second_from_first)
    transform, z_first, z_second = (
        torch.from_numpy(part).to(first_depth)
        for part in (
            matches.second_from_first,
            points[:, 2],
            points @ matches.second_from_first[2, :3] + matches.second_from_first[2, 3],
        )
    )
    good = (z_first > MIN_DEPTH) & (z_second > MIN_DEPTH)
    first, second = (torch.from_numpy(x).to(first_depth)[good] for x in (matches.first, matches.second))
    ratio = (z_first / z_second)[good].log()

    at_first, at_second = _sample(first_depth, first, first_K), _sample(second_depth, second, second_K)
    ray = torch.cat([first, torch.ones_like(first[:, :1])], dim=1)
    moved = (ray * at_first[:, None]) @ transform[:3, :3].T + transform[:3, 3]
    projected = moved[:, :2] / moved[:, 2:].clamp(min=MIN_DEPTH)
    focal = torch.stack([second_K[0, 0] * width, second_K[1, 1] * height])
    distance = ((projected - second) * focal).norm(dim=1)
    ratio_error = ((at_first / at_second).log() - ratio).abs()
    return robust_error(distance, EPIPOLAR_SCALE) + RATIO_WEIGHT * robust_error(ratio_error, RATIO_SCALE)


def _sample(depth: Tensor, points: Tensor, K: Tensor) -> Tensor:
    """Depth [H, W] at normalised image coordinates [points, 2], bilinearly: [points]."""
    in_image = points * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]  # in [0, 1], pixel centres at (i + 0.5) / size
    grid = (2 * in_image - 1)[None, None]
    return F.grid_sample(depth[None, None], grid, padding_mode="border", align_corners=False)[0, 0, 0]
