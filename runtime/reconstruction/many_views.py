"""Prediction for any number of views, in groups as large as the network was trained with, and as fit the memory."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..errors import InputError
from ..inference.predictor import Prediction, Predictor
from ..splats.gaussians import Gaussians
from ..system.progress import progress
from ..system.threads import map_in_threads
from ..views.batch import ViewBatch
from ..views.depth_range import BASELINE, DepthRange
from ..views.groups import ViewGroup, group_views, nearest_views
from .enlarging import network_size, predict_enlarged
from .rating import DepthRating

# Pixels of all views that the network gets together: about 2 GB of memory with the bundled model.
GROUP_PIXELS = 600_000
MIN_GROUP = 3  # views
# Views that vote on a view's points. Half of them see most of the same; the others look from other sides, where a wrong
# depth shows that neighbours agree on because nothing in their images speaks against it.
VOTERS = 24
# Pixels of the predictions that are kept beside those of the views' own groups: about 1.5 GB with the bundled model. Of
# 200 photographs at its default size each has at most one, of 50 four.
OTHER_PIXELS = 16_000_000


def predict_views(
    predictor: Predictor,
    views: ViewBatch,
    span: DepthRange,
    near: float | None = None,
    far: float | None = None,
    for_fusion: bool = False,
) -> Prediction:
    """Depth and Gaussians of all views, each predicted beside the views that suit it best.

    Where groups overlap, a view is predicted several times: each pixel is the one that suits the other views best.
    span: the depth range of all views. near, far: where they are given; else each group has its own depth range, which
    starts where its surfaces do, so that more depth candidates lie there. for_fusion: whether the result is fused, so
    that more time may be spent: images that are too large for the network are given to it smaller (`enlarging`), and
    each view is also predicted beside its best partner alone.
    """
    height, width = views.images.shape[2:]
    predict = predictor.predict_views
    if for_fusion:
        height, width = network_size(predictor.model, height, width)
        predict = partial(predict_enlarged, predictor)
    size = max(MIN_GROUP, min(max(predictor.metadata.trained_views), GROUP_PIXELS // (height * width)))
    groups = group_views(views.cameras, _middle_depths(views, span), size, pairs=for_fusion)
    if len(groups) == 1:
        return predict(views, span.near, span.far)
    range_of = partial(_own_range, predictor, span=span, near=near, far=far)
    parts, seconds = _predict_groups(predict, range_of, views, groups)
    ordered = _choose(parts, views, span)
    gaussians = [part.gaussians for part in ordered if part.gaussians is not None]
    return Prediction(
        np.concatenate([part.depth for part in ordered]),
        Gaussians.concatenate(gaussians) if gaussians else None,
        seconds,
        [part.cameras[0] for part in ordered],
    )


def _predict_groups(
    predict: Callable[[ViewBatch, float, float], Prediction],
    range_of: Callable[[ViewBatch], DepthRange],
    views: ViewBatch,
    groups: Sequence[ViewGroup],
) -> tuple[list[list[Prediction]], dict[str, float]]:
    """All predictions that are kept of each view, that of its own group first, and the seconds that they took."""
    own: dict[int, Prediction] = {}
    others: list[list[Prediction]] = [[] for _ in views.names]
    most_others = OTHER_PIXELS // views.images[:, 0].size
    seconds: dict[str, float] = {}
    for group in progress(groups, "predicting groups of views"):
        members = _subset(views, group.views)
        depths = range_of(members)
        prediction = predict(members, depths.near, depths.far)
        for name, value in prediction.seconds.items():
            seconds[name] = seconds.get(name, 0) + value
        for place, view in enumerate(group.views):
            if view in group.used:
                own[view] = _of_view(prediction, place)
            elif len(others[view]) < most_others:
                others[view].append(_of_view(prediction, place))
    return [[own[view], *rest] for view, rest in enumerate(others)], seconds


def _choose(parts: list[list[Prediction]], views: ViewBatch, span: DepthRange) -> list[Prediction]:
    """One prediction of each view; `parts` is emptied, so that no more than needed stays in memory."""
    rating = DepthRating(np.concatenate([own.depth for own, *_ in parts]), views, voting_views(views, span))

    def choose(view: int) -> Prediction:
        predictions, parts[view] = parts[view], []
        return rating.best(view, predictions)

    return map_in_threads(choose, len(parts))


def _own_range(
    predictor: Predictor, members: ViewBatch, span: DepthRange, near: float | None, far: float | None
) -> DepthRange:
    """The depth range of a group; that of all views where the group's images do not tell it.

    It ends no nearer than that of all views: a group's matches may all be on an object, with a plain wall behind it.
    """
    try:
        found = predictor.depth_range(members, near, far)
    except InputError:  # a near that is given lies behind all that the group sees
        return span
    return span if found.source.endswith(BASELINE) else replace(found, far=max(found.far, span.far))


def voting_views(views: ViewBatch, span: DepthRange) -> list[np.ndarray]:
    """For each view, the others that see most of the same and some from other sides, as indices."""
    others = len(views.names) - 1
    ranked = nearest_views(views.cameras, _middle_depths(views, span), others)
    if others <= VOTERS:
        return ranked
    far = np.linspace(VOTERS // 2, others - 1, VOTERS - VOTERS // 2).astype(int)
    chosen = np.concatenate([np.arange(VOTERS // 2), far])
    return [order[chosen] for order in ranked]


def _middle_depths(views: ViewBatch, span: DepthRange) -> np.ndarray:
    return np.full(len(views.names), np.sqrt(span.near * span.far))


def _subset(views: ViewBatch, chosen: Sequence[int]) -> ViewBatch:
    index = list(chosen)
    return replace(
        views,
        names=[views.names[view] for view in index],
        images=views.images[index],
        extrinsics=views.extrinsics[index],
        intrinsics=views.intrinsics[index],
        cameras=[views.cameras[view] for view in index],
        feature_images=[views.feature_images[view] for view in index] if views.feature_images else (),
        copies=(),
    )


def _of_view(prediction: Prediction, view: int) -> Prediction:
    """The part of one view."""
    gaussians = prediction.gaussians
    pixels = prediction.depth[view].size
    own = None if gaussians is None else gaussians.select(np.arange(view * pixels, (view + 1) * pixels))
    return Prediction(prediction.depth[view : view + 1], own, {}, [prediction.cameras[view]])
