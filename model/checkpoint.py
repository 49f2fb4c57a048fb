"""Strict loading of released checkpoints: every key and every shape, or an error that names what differs."""

import functools
import hashlib
import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from .config import PRESETS, DepthSplatConfig, IDESplatConfig
from .idesplat.network import IDESplat
from .registry import Network, build

# Where a state dict may be nested in a file, and the prefix of the encoder's keys in it.
CONTAINERS = ("state_dict", "model")
PREFIX = "encoder."
# The prefix that the depth-only checkpoints leave away, and a key's beginning by which they are known.
DEPTH_PREFIX = "depth_predictor."
DEPTH_ONLY = "pretrained."
# Released files name the first digits of their SHA-256.
NAMED_HASH = re.compile(r"-([0-9a-f]{8})\.pth$")
# Keys an error message shows before it only counts, and the most characters of a key or a reason that it shows.
SHOWN = 4
LONGEST_SHOWN = 100
# What weights may be stored in; they are used in float32.
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file, what is wrong and what to do."""


def load_idesplat(path: Path, config: IDESplatConfig) -> IDESplat:
    """Build the network and fill it from a file, `.ckpt`, `.pth`, `.pt` or `.safetensors`.

    Raises CheckpointError if the file is unsafe or unreadable, or if any key or shape differs.
    """
    model = IDESplat(config)
    fill(model, read_state_dict(path), path)
    return model.eval()


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """The encoder's tensors of a checkpoint file by their released names, without running code that the file may hold.

    Raises CheckpointError; also for tensors that are no plain arrays on the CPU.
    """
    _check_file(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of PyTorch, about what the file holds; what cannot be used is refused below
        content = _read_safetensors(path) if path.suffix == ".safetensors" else _read_pickle(path)
    for container in CONTAINERS:
        if isinstance(content, dict) and isinstance(content.get(container), dict):
            content = content[container]
            break
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: holds a {type(content).__name__}, expected a state dict; is it a checkpoint?")
    tensors: dict[str, Tensor] = {}
    for key, value in content.items():
        if isinstance(value, Tensor):
            name = _text(path, key)
            tensors[name] = _plain(path, name, value)
    # Released files alone have a depth predictor; this project's own have a stage called encoder. Other prefixes belong
    # to the loss and are not ours.
    if any(key.startswith(PREFIX + DEPTH_PREFIX) for key in tensors):
        tensors = {key.removeprefix(PREFIX): value for key, value in tensors.items() if key.startswith(PREFIX)}
    if not tensors:
        raise CheckpointError(f"{path}: holds no tensors, expected a state dict; is it a checkpoint?")
    if any(key.startswith(DEPTH_ONLY) for key in tensors):
        tensors = {DEPTH_PREFIX + key: value for key, value in tensors.items()}
    return tensors


def _text(path: Path, key: object) -> str:
    """A state dict's key; raises CheckpointError if it is no text."""
    if not isinstance(key, str):
        raise CheckpointError(
            f"{path}: holds a tensor under a key of type {type(key).__name__}, expected names of parameters; "
            "is it a checkpoint?"
        )
    return str(key)


def _plain(path: Path, key: str, value: Tensor) -> Tensor:
    """A tensor without attributes or gradient; raises CheckpointError unless it is a plain array on the CPU."""
    kinds = {
        "sparse": value.layout is not torch.strided,
        "nested": value.is_nested,
        "quantized": value.is_quantized,
        "without values (on the meta device)": value.device.type == "meta",
    }
    for kind, found in kinds.items():
        if found:
            raise CheckpointError(
                f"{path}: {_shown_text(key)} is {kind}, expected a dense tensor; save the state dict with dense tensors"
            )
    return torch.Tensor.detach(value)  # a loaded tensor's own attributes may hide methods


def _shown_text(text: str) -> str:
    """Something of a file as an error message may show it: short, in one line, without control characters."""
    text = text if text.isprintable() and text.isascii() else ascii(text)
    return text if len(text) <= LONGEST_SHOWN else text[:LONGEST_SHOWN] + "..."


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file in hex digits; raises CheckpointError if there is none, or it cannot be read."""
    _check_file(path)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}); expected a checkpoint") from None


def name_hash_warning(path: Path, digest: str) -> str | None:
    """A warning, if the file's name holds the beginning of its SHA-256, as released ones do, and it does not match."""
    named = NAMED_HASH.search(path.name)
    if not named or digest.startswith(named[1]):
        return None
    return f"{path}: its name says that its SHA-256 begins with {named[1]}, but it begins with {digest[:8]}"


def _check_file(path: Path) -> None:
    try:
        exists, regular = path.exists(), path.is_file()
    except OSError as error:  # such as a name that is too long
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}); expected a checkpoint") from None
    if not regular:
        found = "not a regular file" if exists else "no such file"
        raise CheckpointError(f"{path}: {found}; give the path of a released checkpoint (.ckpt, .pth or .safetensors)")


def _read_safetensors(path: Path) -> object:
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except Exception as error:  # its own, of PyTorch for types that it does not know, of the system
        raise CheckpointError(
            f"{path}: not a readable safetensors file ({_reason(error)}); download it again"
        ) from None


def _read_pickle(path: Path) -> object:
    """What torch.save wrote; only tensors and plain containers are rebuilt, whatever the pickle asks for."""
    _check_archive(path)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        wanted = re.search(r"GLOBAL ([\w.]+)", str(error))
        what = f"wants to run {wanted[1]}" if wanted else "is not a plain state dict"
        raise CheckpointError(
            f"{path}: {what}; only tensors and plain containers are loaded, because a pickle can run any code. "
            "Save the state dict alone, or as .safetensors, on a machine where you trust the file"
        ) from None
    except Exception as error:  # damaged content may raise any exception in the unpickler and where tensors are rebuilt
        raise CheckpointError(f"{path}: not a readable checkpoint ({_reason(error)}); download it again") from None


def _check_archive(path: Path) -> None:
    """Refuse an archive whose entries claim more bytes than the file has: torch.save neither packs nor shares them."""
    try:
        with zipfile.ZipFile(path) as archive:
            claimed = sum(entry.file_size for entry in archive.infolist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile, struct.error):
        return  # no archive, as PyTorch's older format is none, or a damaged one, which torch.load refuses
    if claimed > path.stat().st_size:
        raise CheckpointError(
            f"{path}: claims to hold {claimed} bytes in a file of {path.stat().st_size}, expected an archive as "
            "torch.save writes it, not packed; unpack it, or download it again"
        )


def _reason(error: Exception) -> str:
    """The beginning of an exception's message."""
    lines = str(error).strip().splitlines()
    return _shown_text(lines[0]) if lines else type(error).__name__


def fitting_presets(tensors: dict[str, Tensor]) -> list[str]:
    """Names of the presets whose keys and shapes are exactly the file's."""
    renamed = rename_released(tensors)
    return [name for name, config in PRESETS.items() if not _differences(_expected_shapes(config), renamed)]


def infer_preset(path: Path, tensors: dict[str, Tensor]) -> str:
    """The preset of a checkpoint: the one that its tensors fit and, among several, that its name names.

    Raises CheckpointError if no preset fits, or several do and the name does not decide.
    """
    fitting = fitting_presets(tensors)
    words = _words(path.name)
    # What all of the fitting presets' names have in common says nothing about which of them it is.
    common = set.intersection(*map(_words, fitting)) if fitting else set()
    named = [name for name in fitting if _words(name) - common <= words]
    if len(named or fitting) == 1:
        return (named or fitting)[0]
    if not fitting:
        closest = min(
            PRESETS, key=lambda name: len(_differences(_expected_shapes(PRESETS[name]), rename_released(tensors)))
        )
        different = _differences(_expected_shapes(PRESETS[closest]), rename_released(tensors))
        raise CheckpointError(
            f"{path}: fits none of the presets {', '.join(PRESETS)}; from {closest} it differs in {_shown(different)}"
        )
    raise CheckpointError(
        f"{path}: fits the presets {', '.join(fitting)}, and its name does not say which; choose with --preset"
    )


def _words(name: str) -> set[str]:
    return set(re.split(r"[^a-z0-9]+", name.lower()))


def fill(model: Network, tensors: dict[str, Tensor], path: Path) -> None:
    """Load released tensors into a model.

    Raises CheckpointError naming the first keys that differ, or whose values are no floating-point or finite numbers.
    """
    renamed = rename_released(tensors)
    own = model.state_dict()
    different = _differences({key: tuple(value.shape) for key, value in own.items()}, renamed)
    if different:
        raise CheckpointError(
            f"{path}: does not fit the network: {_shown(different)}; choose the preset it was trained with"
        )
    _check_values(renamed, path)
    model.load_state_dict({key: value.reshape(own[key].shape) for key, value in renamed.items()})


def _check_values(tensors: dict[str, Tensor], path: Path) -> None:
    """Refuse weights, whose shapes are known to fit, that are no numbers to compute with."""
    integers = [f"{key} holds {value.dtype}" for key, value in tensors.items() if value.dtype not in FLOATS]
    if integers:
        raise CheckpointError(
            f"{path}: {_shown(integers)}; expected floating-point weights, such as torch.float32: save it with those"
        )
    damaged = [f"{key} holds NaN or infinity" for key, value in tensors.items() if not value.isfinite().all()]
    if damaged:
        raise CheckpointError(
            f"{path}: {_shown(damaged)}; expected finite weights: download it again, or save an earlier state"
        )


@functools.cache
def _expected_shapes(config: IDESplatConfig | DepthSplatConfig) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {key: tuple(value.shape) for key, value in build(config).state_dict().items()}


def _differences(expected: dict[str, tuple[int, ...]], tensors: dict[str, Tensor]) -> list[str]:
    """What differs, in words: missing keys, keys unknown, shapes."""
    missing = [f"{key} is missing" for key in expected if key not in tensors]
    unknown = [f"{_shown_text(key)} is unknown" for key in tensors if key not in expected]
    shapes = [
        f"{key} has shape {tuple(tensors[key].shape)} instead of {shape}"
        for key, shape in expected.items()
        if key in tensors and tuple(tensors[key].squeeze().shape) != tuple(size for size in shape if size != 1)
    ]
    return missing + shapes + unknown


def _shown(differences: list[str]) -> str:
    more = f" and {len(differences) - SHOWN} more" if len(differences) > SHOWN else ""
    return ", ".join(differences[:SHOWN]) + more


def rename_released(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors by this project's names; those that no network uses are left out, other unknown keys keep their name."""
    renamed = {rename_key(key): value for key, value in tensors.items() if not UNUSED.search(key)}
    two_scales = any(key.startswith("depth2.") for key in renamed)
    stages = {"last_depth": "depth2"} if two_scales else {"last_depth": "depth", "depth1": "depth"}
    return {_in_stage(key, stages): value for key, value in renamed.items()}


def _in_stage(key: str, stages: dict[str, str]) -> str:
    stage, dot, rest = key.partition(".")
    return stages.get(stage, stage) + dot + rest


def rename_key(key: str) -> str:
    """A released key by this project's name; which of DepthSplat's scales comes last, one key alone does not say."""
    for pattern, replacement in RENAMES:
        key = pattern.sub(replacement, key)
    return key


# Weights that the releases carry and never use: the ViT's mask token, the coarsest fusion's lateral unit, a second
# projection in the focused layers; and an index that follows from the window size.
UNUSED = re.compile(
    r"pretrained\.mask_token$|refinenet4\.resConfUnit1\.|gaussian_layers\.\d+\.proj\.|relative_position_index_SA$"
)


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


def _depth_stage(match: re.Match[str]) -> str:
    """Scales are numbered from zero, stages from one."""
    return f"depth{int(match[1]) + 1}"


def _counted_down(name: str) -> Callable[[re.Match[str]], str]:
    """Numbering from one -> from zero."""
    return lambda match: f"{name}.{int(match[1]) - 1}."


Replacement = str | Callable[[re.Match[str]], str]
_RULES: list[tuple[str, Replacement]] = [
    # this project's own names before version 2
    (r"\.grow(_|\d\.)", r".upsample\1"),
    (r"\.shrink2\.", ".downsample."),
    # stages
    (r"^depth_predictor\.(backbone|transformer)\.", r"encoder.\1."),
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
    (r"^depth_predictor\.pretrained\.", "encoder.vit."),
    (r"^depth_predictor\.(mv|mono)_pyramid\.stages\.1\.", r"depth2.upsample_\1."),
    (r"^depth_predictor\.regressor\.(\d)\.", lambda match: f"{_depth_stage(match)}.regulariser."),
    (r"^depth_predictor\.regressor_residual\.(\d)\.", lambda match: f"{_depth_stage(match)}.shortcut."),
    (r"^depth_predictor\.depth_head\.(\d)\.0\.", lambda match: f"{_depth_stage(match)}.head1."),
    (r"^depth_predictor\.depth_head\.(\d)\.2\.", lambda match: f"{_depth_stage(match)}.head2."),
    (r"^depth_predictor\.upsampler\.", "last_depth.upsampler."),
    (r"^feature_upsampler\.", "gaussians.upsampler."),
    (r"^gaussian_regressor\.0\.", "gaussians.regressor1."),
    (r"^gaussian_regressor\.2\.", "gaussians.regressor2."),
    (r"^gaussian_head\.0\.", "gaussians.head1."),
    (r"^gaussian_head\.2\.", "gaussians.head2."),
    # backbone and multi-view transformer
    (r"\.downsample\.0\.", ".shortcut."),
    (r"\.cross_attn_ffn\.mlp\.0\.", ".mlp1."),
    (r"\.cross_attn_ffn\.mlp\.2\.", ".mlp2."),
    (r"\.cross_attn_ffn\.norm2\.", ".norm."),
    (r"\.(self_attn|cross_attn)(?:_ffn)?\.norm1\.", r".\1.norm."),
    (r"\.cross_attn_ffn\.", ".cross_attn."),
    # ViT and DPT head
    (r"\.patch_embed\.proj\.", ".patch_embed."),
    (r"\.ls([12])\.gamma$", r".scale\1"),
    (r"\.mlp\.fc([12])\.", r".fc\1."),
    (r"\.resize_layers\.0\.", ".upsample4."),
    (r"\.resize_layers\.1\.", ".upsample2."),
    (r"\.resize_layers\.3\.", ".downsample."),
    (r"scratch\.layer(\d)_rn\.", _counted_down("laterals")),
    (r"scratch\.refinenet(\d)\.", _counted_down("fusions")),
    (r"\.resConfUnit1\.", ".lateral."),
    (r"\.resConfUnit2\.", ".unit."),
    (r"\.concat_projects\.", ".merges."),
    (r"scratch\.output_conv\.0\.", "residual1."),
    (r"scratch\.output_conv\.2\.", "residual2."),
    (r"scratch\.output_conv\.4\.", "residual3."),
    (r"scratch\.output_conv1\.", "disparity1."),
    (r"scratch\.output_conv2\.0\.", "disparity2."),
    (r"scratch\.output_conv2\.2\.", "disparity3."),
    # epipolar attention and the focused module
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
    # U-Nets
    (r"\.Sim_UNet\.", ".regulariser."),
    (r"(residual|regulariser)\.0\.", r"\1.conv_in."),
    (r"(residual|regulariser)\.1\.", r"\1.norm_in."),
    (r"(residual|regulariser)\.3\.", r"\1.unet."),
    (r"(residual|regulariser)\.4\.", r"\1.conv_out."),
    (r"input_blocks\.(\d+)\.(\d)\.(?:op\.)?", _unet_input),
    (r"output_blocks\.(\d+)\.(\d\.(?:conv\.)?)", _unet_output),
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
RENAMES = [(re.compile(pattern), replacement) for pattern, replacement in _RULES]
