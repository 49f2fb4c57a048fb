"""The released IDESplat checkpoints' keys by this project's names."""

from torch import Tensor

from ..common import released_keys as shared

RULES: list[shared.Rule] = [
    *shared.FORMER_NAMES,
    *shared.ENCODER,
    (r"^depth_predictor\.depth_anything\.pretrained\.", "encoder.vit."),
    (r"^depth_predictor\.depth_anything\.depth_head\.", "encoder.dpt."),
    (r"^depth_predictor\.conv_mv\.", "dpbu1.merge.conv."),
    (r"^depth_predictor\.conv_mv_u2\.", "dpbu2.merge.conv."),
    (r"^depth_predictor\.conv_mv_u4\.", "dpbu3.merge.conv."),
    (r"^depth_predictor\.cvo_pyramid_u2\.stages\.0\.", "dpbu2.upsample_features."),
    (r"^depth_predictor\.mv_pyramid_u2\.stages\.0\.", "dpbu2.upsample_context."),
    (r"^depth_predictor\.cvo_pyramid_u4\.stages\.0\.", "dpbu3.upsample_features."),
    (r"^depth_predictor\.mv_pyramid_u4\.stages\.0\.", "dpbu3.upsample_context."),
    (r"^depth_predictor\.features_cnn_u2\.stages\.0\.", "dpbu3.upsample_cnn."),
    (r"^depth_predictor\.wiea_f(\d)_1\.", r"dpbu\1.first."),
    (r"^depth_predictor\.wiea_f(\d)_2\.", r"dpbu\1.second."),
    (r"^depth_predictor\.res_depth_head\.", "gaussians.residual."),
    (r"^depth_predictor\.conv_image\.", "gaussians.conv_image."),
    (r"^depth_predictor\.gaussian_fuse\.", "gaussians.fuse."),
    (r"^depth_predictor\.gaussian_layers\.", "gaussians.focus.layers."),
    (r"^depth_predictor\.gaussian_conv\.", "gaussians.expand."),
    (r"^gaussian_head\.0\.", "gaussians.head1."),
    (r"^gaussian_head\.2\.", "gaussians.head2."),
    *shared.BACKBONE_AND_TRANSFORMER,
    *shared.VIT_AND_DPT,
    (r"scratch\.output_conv1\.", "disparity1."),
    (r"scratch\.output_conv2\.0\.", "disparity2."),
    (r"scratch\.output_conv2\.2\.", "disparity3."),
    # epipolar attention and the Gaussian focused module
    (r"\.k_pe$", ".key_position"),
    (r"\.v_pe$", ".value_position"),
    (r"\.rpe$", ".score_position"),
    (r"\.mv_norm([12])\.", r".norm\1."),
    (r"\.(?:w_)?W([qkv])\.", r".\1_proj."),
    (r"\.convffn\.", ".ffn."),
    (r"\.dwconv\.depthwise_conv\.0\.", ".depthwise.conv."),
    (r"\.v_LePE\.depthwise_conv\.0\.", ".v_depthwise.conv."),
    (r"\.attn_win\.relative_position_bias_table$", ".position_bias"),
    (r"\.attn_win\.proj\.", ".proj."),
    (r"\.Sim_UNet\.", ".regulariser."),
    *shared.UNET,
]
# Besides what all releases leave unused: a second projection in the focused layers, and an index that follows from the
# window size.
UNUSED = rf"{shared.UNUSED}|gaussian_layers\.\d+\.proj\.|relative_position_index_SA$"
RENAMING = shared.KeyRenaming(RULES, UNUSED)


def rename_released(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """A checkpoint's tensors by this project's names; unknown keys keep their name."""
    return RENAMING.rename(shared.unwrap(tensors))
