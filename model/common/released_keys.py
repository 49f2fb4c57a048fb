"""Renaming of the released checkpoints' keys for the parts that networks share; each family adds rules of its own."""

import re
from collections.abc import Callable, Iterable

from torch import Tensor

Replacement = str | Callable[[re.Match[str]], str]
Rule = tuple[str, Replacement]
# Lightning saves the network as the attribute `encoder` of its wrapper. Only released files have a depth predictor
# below it; this project's own have a stage called encoder.
WRAPPER = "encoder."
DEPTH_PREDICTOR = "depth_predictor."


def unwrap(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The network's tensors without the wrapper's prefix; in released files, other prefixes belong to the loss."""
    if not any(key.startswith(WRAPPER + DEPTH_PREDICTOR) for key in tensors):
        return tensors
    return {key.removeprefix(WRAPPER): value for key, value in tensors.items() if key.startswith(WRAPPER)}


class KeyRenaming:
    """Ordered substitutions, each applied to what the ones before it made of a key."""

    def __init__(self, rules: Iterable[Rule], unused: str) -> None:
        """rules: regular expressions with their replacements. unused: matches keys that no network reads."""
        self.rules = [(re.compile(pattern), replacement) for pattern, replacement in rules]
        self.unused = re.compile(unused)

    def rename_key(self, key: str) -> str:
        """A released key by this project's name."""
        for pattern, replacement in self.rules:
            key = pattern.sub(replacement, key)
        return key

    def rename(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Tensors by this project's names, without the unused ones; unknown keys keep their name."""
        return {self.rename_key(key): value for key, value in tensors.items() if not self.unused.search(key)}


def count_from_zero(name: str) -> Callable[[re.Match[str]], str]:
    """Numbering from one -> from zero."""
    return lambda match: f"{name}.{int(match[1]) - 1}."


def _unet_input(match: re.Match[str]) -> str:
    """U-Net blocks on the way down alternate: 0 the first convolution, odd ones a level, even ones a downsampling."""
    block, part = int(match[1]), match[2]
    if block == 0:
        return "conv_in."
    if block % 2 == 0:
        return f"downsamples.{block // 2 - 1}."
    return f"down_blocks.{block // 2}." if part == "0" else "down_attention."


def _unet_output(match: re.Match[str]) -> str:
    """U-Net blocks on the way up come in pairs; the second of a pair may end with an upsampling."""
    block, rest = int(match[1]), match[2]
    if rest == "0.":
        return f"up_blocks.{block}."
    return f"upsamples.{block // 2}." if rest.endswith("conv.") else f"up_attention.{block}."


# The ViT's mask token and the coarsest fusion's lateral unit, which the releases save and never read.
UNUSED = r"pretrained\.mask_token$|refinenet4\.resConfUnit1\."
# What files of this project before version 0.2 call the upsampling and downsampling layers.
FORMER_NAMES: list[Rule] = [(r"\.grow(_|\d\.)", r".upsample\1"), (r"\.shrink2\.", ".downsample.")]
ENCODER: list[Rule] = [(r"^depth_predictor\.(backbone|transformer)\.", r"encoder.\1.")]
BACKBONE_AND_TRANSFORMER: list[Rule] = [
    (r"\.downsample\.0\.", ".shortcut."),
    (r"\.cross_attn_ffn\.mlp\.0\.", ".mlp1."),
    (r"\.cross_attn_ffn\.mlp\.2\.", ".mlp2."),
    (r"\.cross_attn_ffn\.norm2\.", ".norm."),
    (r"\.(self_attn|cross_attn)(?:_ffn)?\.norm1\.", r".\1.norm."),
    (r"\.cross_attn_ffn\.", ".cross_attn."),
]
VIT_AND_DPT: list[Rule] = [
    (r"\.patch_embed\.proj\.", ".patch_embed."),
    (r"\.ls([12])\.gamma$", r".scale\1"),
    (r"\.mlp\.fc([12])\.", r".fc\1."),
    (r"\.resize_layers\.0\.", ".upsample4."),
    (r"\.resize_layers\.1\.", ".upsample2."),
    (r"\.resize_layers\.3\.", ".downsample."),
    (r"scratch\.layer(\d)_rn\.", count_from_zero("laterals")),
    (r"scratch\.refinenet(\d)\.", count_from_zero("fusions")),
    (r"\.resConfUnit1\.", ".lateral."),
    (r"\.resConfUnit2\.", ".unit."),
]
UNET: list[Rule] = [
    (r"(residual|regulariser)\.0\.", r"\1.conv_in."),
    (r"(residual|regulariser)\.1\.", r"\1.norm_in."),
    (r"(residual|regulariser)\.3\.", r"\1.unet."),
    (r"(residual|regulariser)\.4\.", r"\1.conv_out."),
    # Python converts no more than 4300 digits to a number.
    (r"input_blocks\.(\d{1,4})\.(\d)\.(?:op\.)?", _unet_input),
    (r"output_blocks\.(\d{1,4})\.(\d\.(?:conv\.)?)", _unet_output),
    (r"middle_block\.0\.", "middle.0."),
    (r"middle_block\.2\.", "middle.1."),
    (r"unet\.out\.0\.", "unet.norm_out."),
    (r"unet\.out\.2\.", "unet.conv_out."),
    (r"\.in_layers\.0\.", ".norm1."),
    (r"\.in_layers\.2\.", ".conv1."),
    (r"\.out_layers\.0\.", ".norm2."),
    (r"\.out_layers\.3\.", ".conv2."),
    (r"\.skip_connection\.", ".shortcut."),
]
