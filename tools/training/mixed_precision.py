"""bfloat16 for the layers that gain from it in training on a CPU: whole modules compute under autocast.

Geometry, softmax over candidates, gather attention, the Gaussians and all losses stay in float32: only what goes in and
comes out of a wrapped module is converted.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor, nn

from ...model.common.backbone import Backbone
from ...model.common.dinov2 import DinoV2
from ...model.common.dpt import DPTHead
from ...model.common.layers import ConcatConv1x1, ConvFFN, Upsample2x
from ...model.common.mv_transformer import MultiViewTransformer
from ...model.common.unet import CostRegulariser
from ...model.idesplat.focused_attention import GaussianFocusedModule
from ...model.idesplat.network import IDESplat
from ...model.idesplat.photographic_branch import PhotoBranch

LOWERED = (
    *(Backbone, MultiViewTransformer, DinoV2, PhotoBranch, CostRegulariser),
    *(ConvFFN, ConcatConv1x1, Upsample2x, GaussianFocusedModule),
)
# Methods of modules that are not called by `forward`.
LOWERED_METHODS = {DPTHead: ("features",)}


def with_bfloat16(model: IDESplat) -> IDESplat:
    """The same network, with the modules of LOWERED under autocast; weights stay in float32."""
    for module in model.modules():
        if isinstance(module, LOWERED):
            _lower(module, "forward")
        for kind, names in LOWERED_METHODS.items():
            if isinstance(module, kind):
                for name in names:
                    _lower(module, name)
    return model


def _lower(module: nn.Module, name: str) -> None:
    method: Callable[..., Any] = getattr(module, name)

    @wraps(method)
    def lowered(*arguments: Any) -> Any:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = method(*arguments)
        return _raised(found)

    setattr(module, name, lowered)


def _raised(value: Any) -> Any:
    """Tensors in bfloat16, in sequences too, as float32."""
    if isinstance(value, Tensor):
        return value.float() if value.dtype == torch.bfloat16 else value
    if isinstance(value, tuple | list):
        return type(value)(_raised(part) for part in value)
    return value
