"""The released DepthSplat checkpoints' keys by this project's names."""

import re

from torch import Tensor

from ..common import released_keys as shared

# The depth-only checkpoints lack the depth predictor's prefix; they are recognised by a key that begins so.
DEPTH_ONLY = "pretrained."


def _scale(match: re.Match[str]) -> str:
    """The releases number scales from zero; stages are numbered from one."""
    return f"depth{int(match[1]) + 1}"


RULES: list[shared.Rule] = [
    *shared.FORMER_NAMES,
    *shared.ENCODER,
    (r"^depth_predictor\.pretrained\.", "encoder.vit."),
    (r"^depth_predictor\.(mv|mono)_pyramid\.stages\.1\.", r"depth2.upsample_\1."),
    (r"^depth_predictor\.regressor\.(\d)\.", lambda match: f"{_scale(match)}.regulariser."),
    (r"^depth_predictor\.regressor_residual\.(\d)\.", lambda match: f"{_scale(match)}.shortcut."),
    (r"^depth_predictor\.depth_head\.(\d)\.0\.", lambda match: f"{_scale(match)}.head1."),
    (r"^depth_predictor\.depth_head\.(\d)\.2\.", lambda match: f"{_scale(match)}.head2."),
    (r"^depth_predictor\.upsampler\.", "last_depth.upsampler."),
    (r"^feature_upsampler\.", "gaussians.upsampler."),
    (r"^gaussian_regressor\.0\.", "gaussians.regressor1."),
    (r"^gaussian_regressor\.2\.", "gaussians.regressor2."),
    (r"^gaussian_head\.0\.", "gaussians.head1."),
    (r"^gaussian_head\.2\.", "gaussians.head2."),
    *shared.BACKBONE_AND_TRANSFORMER,
    *shared.VIT_AND_DPT,
    (r"\.concat_projects\.", ".merges."),
    (r"scratch\.output_conv\.0\.", "residual1."),
    (r"scratch\.output_conv\.2\.", "residual2."),
    (r"scratch\.output_conv\.4\.", "residual3."),
    *shared.UNET,
]
RENAMING = shared.KeyRenaming(RULES, shared.UNUSED)


def rename_released(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """A checkpoint's tensors by this project's names; unknown keys keep their name."""
    tensors = shared.unwrap(tensors)
    if any(key.startswith(DEPTH_ONLY) for key in tensors):
        tensors = {shared.DEPTH_PREDICTOR + key: value for key, value in tensors.items()}
    renamed = RENAMING.rename(tensors)
    # One key alone does not say which scale comes last.
    two_scales = any(key.startswith("depth2.") for key in renamed)
    stages = {"last_depth": "depth2"} if two_scales else {"last_depth": "depth", "depth1": "depth"}
    return {_rename_stage(key, stages): value for key, value in renamed.items()}


def _rename_stage(key: str, stages: dict[str, str]) -> str:
    stage, dot, rest = key.partition(".")
    return stages.get(stage, stage) + dot + rest
