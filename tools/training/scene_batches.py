"""Several scenes in one pass of the network.

A GPU computes two small views in many short kernels, most of which leave it idle; the views of several scenes at once
take hardly longer. The network takes them as the views of one scene. What relates views to each other is restricted to
views of the same scene here: the choice of neighbours, the U-Nets' cross-view attention, and the largest monocular
disparity. All else in the network works on single views, or looks neighbours up by their index.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from ...model.common.geometry import nearest_views
from ...model.common.unet import CostRegulariser
from ...model.idesplat.network import IDESplat


@contextmanager
def separate_scenes(model: IDESplat, scenes: int) -> Iterator[None]:
    """Within this context, `model` takes the views of `scenes` scenes, each with as many, and no scene sees another."""
    if scenes == 1:
        yield
        return

    def neighbours_in_scene(extrinsics: Tensor, count: int) -> Tensor:
        parts = extrinsics.chunk(scenes)
        return torch.cat([nearest_views(part, count) + index * len(part) for index, part in enumerate(parts)])

    def group_views(_: nn.Module, inputs: tuple[Tensor, int]) -> tuple[Tensor, int]:
        maps, views = inputs
        return maps, views // scenes

    def largest_of_scene(_: nn.Module, __: Any, outputs: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, ...]:
        *features, disparity = outputs
        largest = disparity.reshape(scenes, -1).amax(1).repeat_interleave(len(disparity) // scenes)
        return *features, disparity / largest[:, None, None, None]

    handles = [
        module.register_forward_pre_hook(group_views)
        for module in model.modules()
        if isinstance(module, CostRegulariser)
    ]
    if model.encoder.photo is not None:
        handles.append(model.encoder.photo.register_forward_hook(largest_of_scene))
    model.encoder.nearest_views = neighbours_in_scene
    try:
        yield
    finally:
        model.encoder.nearest_views = nearest_views
        for handle in handles:
            handle.remove()
