"""Strict and safe loading of checkpoints: every key and every shape, or an error that names what differs.

Reading is the same for every network; each family renames the keys of its releases (`Family.rename_released`).
"""

import functools
import hashlib
import pickle
import re
import struct
import warnings
import zipfile
from pathlib import Path

import torch
from torch import Tensor

from .common.network import Network
from .config import EncoderConfig
from .registry import FAMILIES, PRESETS, build, family_of

# Keys under which a file may nest its state dict.
CONTAINERS = ("state_dict", "model")
# Released files name the first digits of their SHA-256.
NAMED_HASH = re.compile(r"-([0-9a-f]{8})\.pth$")
# Limits of an error message: keys that are named, the others are counted, and characters of a key or a reason.
SHOWN = 4
LONGEST_SHOWN = 100
# Types in which weights may be stored; they are converted to float32.
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file, what is wrong and the remedy."""


def load_checkpoint(path: Path, preset: str | EncoderConfig | None = None) -> Network:
    """A network with the weights of a file: `.ckpt`, `.pth`, `.pt` or `.safetensors`.

    preset: name of a preset, or a configuration; by default the preset that the tensors and the file's name tell.
    Raises CheckpointError if the file is unsafe or unreadable, if any key or shape differs, or if the preset is not
    determined; KeyError if the preset is unknown.
    """
    tensors = read_state_dict(path)
    model = build(infer_preset(path, tensors) if preset is None else preset)
    fill(model, tensors, path)
    return model.eval()


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint file by the names in the file, without running code that the file may hold.

    Raises CheckpointError if the file is unsafe or unreadable, or holds tensors that are not dense or have no values.
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
    if not tensors:
        raise CheckpointError(f"{path}: holds no tensors, expected a state dict; is it a checkpoint?")
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
    """A tensor without attributes or gradient; raises CheckpointError unless it is dense and has values."""
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
    """Text from a file for an error message: short, in one line, without control characters."""
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
    """A warning if the file's name holds the beginning of a SHA-256, as released names do, and it is not the file's."""
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
    """The content of a file of torch.save; only tensors and plain containers are unpickled."""
    check_archive(path)
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


def check_archive(path: Path) -> None:
    """Raise CheckpointError for an archive whose entries claim more bytes than it has: torch.save does not compress."""
    try:
        with zipfile.ZipFile(path) as archive:
            claimed = sum(entry.file_size for entry in archive.infolist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile, struct.error):
        return  # PyTorch's older format, which is no archive, or a damaged archive, which torch.load refuses
    if claimed > path.stat().st_size:
        raise CheckpointError(
            f"{path}: claims to hold {claimed} bytes in a file of {path.stat().st_size}, expected an archive as "
            "torch.save writes it, not packed; unpack it, or download it again"
        )


def _reason(error: Exception) -> str:
    """The beginning of an exception's message."""
    lines = str(error).strip().splitlines()
    return _shown_text(lines[0]) if lines else type(error).__name__


def infer_preset(path: Path, tensors: dict[str, Tensor]) -> str:
    """The preset of a checkpoint: the one whose shapes the tensors have and, among several, that the file's name tells.

    Raises CheckpointError if no preset fits, or several do and the name does not decide.
    """
    differences = _differences_by_preset(tensors)
    fitting = [name for name, different in differences.items() if not different]
    words = _words(path.name)
    # Words that all of the fitting presets share do not tell them apart.
    common = set.intersection(*map(_words, fitting)) if fitting else set()
    named = [name for name in fitting if _words(name) - common <= words]
    if len(named or fitting) == 1:
        return (named or fitting)[0]
    if not fitting:
        closest = min(differences, key=lambda name: len(differences[name]))
        raise CheckpointError(
            f"{path}: fits none of the presets {', '.join(differences)}; from {closest} it differs in "
            f"{_shown(differences[closest])}"
        )
    raise CheckpointError(
        f"{path}: fits the presets {', '.join(fitting)}, and its name does not say which; choose with --preset"
    )


def _differences_by_preset(tensors: dict[str, Tensor]) -> dict[str, list[str]]:
    """What differs from each preset, with the tensors named as its family names them."""
    renamed = {family.name: family.rename_released(tensors) for family in FAMILIES}
    return {
        name: _differences(_expected_shapes(config), renamed[family_of(config).name])
        for name, config in PRESETS.items()
    }


def _words(name: str) -> set[str]:
    return set(re.split(r"[^a-z0-9]+", name.lower()))


def fill(model: Network, tensors: dict[str, Tensor], path: Path) -> None:
    """Load released tensors into a model.

    Raises CheckpointError naming the first keys that differ, or whose values are no floating-point or finite numbers.
    """
    renamed = family_of(model.config).rename_released(tensors)
    own = model.state_dict()
    different = _differences({key: tuple(value.shape) for key, value in own.items()}, renamed)
    if different:
        raise CheckpointError(
            f"{path}: does not fit the network: {_shown(different)}; choose the preset it was trained with"
        )
    _check_values(renamed, path)
    model.load_state_dict({key: value.reshape(own[key].shape) for key, value in renamed.items()})


def _check_values(tensors: dict[str, Tensor], path: Path) -> None:
    """Refuse weights that are not floating-point or not finite."""
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
def _expected_shapes(config: EncoderConfig) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        return {key: tuple(value.shape) for key, value in build(config).state_dict().items()}


def _differences(expected: dict[str, tuple[int, ...]], tensors: dict[str, Tensor]) -> list[str]:
    """Messages of what differs: missing keys, shapes, unknown keys."""
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
