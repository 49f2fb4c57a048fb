"""bfloat16 training: some modules compute under autocast.

Geometry, softmax over candidates, gather attention, the Gaussians and all losses stay in float32. Inputs and outputs of
a wrapped module are converted.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor, nn

from ...model.common.backbone import Backbone
from ...model.common.dinov2 import DinoV2
from ...model.common.dpt import DPTHead
from ...model.common.layers import ConcatConv1x1, ConvFFN, DepthwiseConv, Upsample2x
from ...model.common.mv_transformer import MultiViewTransformer
from ...model.common.unet import CostRegulariser
from ...model.idesplat.focused_attention import GaussianFocusedModule
from ...model.idesplat.network import IDESplat
from ...model.idesplat.photographic_branch import PhotoBranch

BF16_MODULES = (
    *(Backbone, MultiViewTransformer, DinoV2, PhotoBranch, CostRegulariser),
    *(ConvFFN, ConcatConv1x1, Upsample2x, GaussianFocusedModule),
)
# Methods that `forward` does not call.
BF16_METHODS = {DPTHead: ("features",)}
# Modules inside those whose gradients take three to five times as long in bfloat16 on a CPU: depthwise convolutions of
# maps in channels-last order.
FLOAT32_MODULES = (DepthwiseConv,)


def with_bfloat16(model: IDESplat) -> IDESplat:
    """The same network, with BF16_MODULES but for FLOAT32_MODULES under autocast; weights stay in float32."""
    for module in model.modules():
        if isinstance(module, FLOAT32_MODULES):
            _run_in_float32(module)
        if isinstance(module, BF16_MODULES):
            _run_in_bf16(module, "forward")
        for kind, names in BF16_METHODS.items():
            if isinstance(module, kind):
                for name in names:
                    _run_in_bf16(module, name)
    return model


def _run_in_bf16(module: nn.Module, name: str) -> None:
    method: Callable[..., Any] = getattr(module, name)

    @wraps(method)
    def in_bf16(*arguments: Any) -> Any:
        with torch.autocast(next(module.parameters()).device.type, dtype=torch.bfloat16):
            found = method(*arguments)
        return _to_float32(found)

    setattr(module, name, in_bf16)


def _run_in_float32(module: nn.Module) -> None:
    method = module.forward

    @wraps(method)
    def in_float32(maps: Tensor) -> Tensor:
        with torch.autocast(maps.device.type, enabled=False):
            return method(maps.float())

    module.forward = in_float32


def _to_float32(value: Any) -> Any:
    """bfloat16 tensors, also inside tuples and lists, as float32."""
    if isinstance(value, Tensor):
        return value.float() if value.dtype == torch.bfloat16 else value
    if isinstance(value, tuple | list):
        return type(value)(_to_float32(part) for part in value)
    return value
