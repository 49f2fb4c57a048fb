"""The state of a training run: weights, their exponential moving average (EMA), optimiser and step."""

import math
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from ...model.checkpoint import CheckpointError, fill, read_state_dict
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.keys import rename_released
from ...model.idesplat.network import IDESplat
from ...runtime.errors import InputError
from ...runtime.system.files import atomic_write, check_regular
from .gather_attention import use_training_gather_attention
from .initialization import new_model
from .settings import TrainingSettings

# EMA of the weights w at step n: ema <- d ema + (1 - d) w with d = min(EMA_DECAY, n / (n + EMA_START)).
EMA_DECAY = 0.99
EMA_START = 10
WEIGHT_DECAY = 0.01
MAX_GRADIENT_NORM = 1.0
# The ViT's parameters and those with ImageNet weights have learning rates of their own.
VIT_PREFIX = "encoder.vit."
PHOTO_NETWORK_PREFIX = "encoder.photo.network."
# Settings that checkpoints of earlier versions have under another name.
RENAMED_SETTINGS = {"gradual": "curriculum"}
# Settings that checkpoints of earlier versions may lack, with what those versions did.
DEFAULT_SETTINGS = {field.name: field.default for field in fields(TrainingSettings) if field.default is not MISSING}
# A part that older checkpoints lack; newly initialised, it is an identity.
OPTIONAL_PREFIX = "gaussians.cross_view."
# The monocular branch: a network with EfficientNet-Lite0 can start from one with a ViT.
PHOTO_PREFIX, VIT_BRANCH_PREFIXES = "encoder.photo.", ("encoder.vit.", "encoder.dpt.")
MERGE_WEIGHTS = {f"dpbu{number}.merge.conv.weight" for number in (1, 2, 3)}


class TrainingState:
    """The network in training. step: the number of steps done."""

    def __init__(
        self,
        config: IDESplatConfig,
        seed: int,
        lr: float,
        vit_lr: float,
        photo_lr: float = 0.0,
        trained: tuple[str, ...] = ("",),
        device: str = "cpu",
    ) -> None:
        """A new network, with random weights of `seed`.

        lr, vit_lr, photo_lr: highest learning rates, of EfficientNet-Lite0 the last; 0 leaves its parameters frozen.
        trained: prefixes of the names of the trained parameters; the others are frozen. device: where it is trained.
        Raises InputError if no parameter is trained.
        """
        self.device = torch.device(device)
        self.model = use_training_gather_attention(new_model(config, seed)).to(self.device)
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.step = 0
        rates = {VIT_PREFIX: vit_lr, PHOTO_NETWORK_PREFIX: photo_lr, "": lr}
        groups: dict[str, dict[str, Any]] = {prefix: {"params": [], "highest": rate} for prefix, rate in rates.items()}
        for name, parameter in self.model.named_parameters():
            prefix = next(prefix for prefix in rates if name.startswith(prefix))
            parameter.requires_grad_(name.startswith(trained) and rates[prefix] > 0)
            if parameter.requires_grad:
                groups[prefix]["params"].append(parameter)
        used = [group for group in groups.values() if group["params"]]
        if not used:
            raise InputError(f"--lr {lr:g}: nothing would be trained; give a learning rate above 0")
        self.optimizer = torch.optim.AdamW(used, lr=lr, weight_decay=WEIGHT_DECAY, fused=True)

    def start_from(self, path: Path) -> None:
        """Load the weights of a checkpoint, released or own; raises InputError if it does not fit the network."""
        try:
            fill(self.model, _with_missing_parts(rename_released(read_state_dict(path)), self.model), path)
        except CheckpointError as error:
            raise InputError(str(error)) from None
        self.reset_ema()

    def reset_ema(self) -> None:
        """Restart the EMA from the current weights."""
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}

    def update(self, lr_factor: float) -> float:
        """Make an optimiser step at `lr_factor` times the highest learning rates; returns the gradient's norm.

        A step whose gradient is not finite leaves the weights unchanged.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = lr_factor * group["highest"]
        norm = float(nn.utils.clip_grad_norm_(self.model.parameters(), MAX_GRADIENT_NORM))
        if math.isfinite(norm):
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.step += 1
        decay = min(EMA_DECAY, self.step / (self.step + EMA_START))
        weights = self.model.state_dict()
        get_ema_multi_avg_fn(decay)(list(self.ema.values()), [weights[name] for name in self.ema], None)
        return norm

    def ema_model(self) -> IDESplat:
        """The network with the EMA of the weights, which predicts better than the last weights."""
        model = use_training_gather_attention(IDESplat(self.model.config).eval())
        model.load_state_dict(self.ema)
        return model.to(self.device)

    def save(self, path: Path, settings: dict[str, Any]) -> None:
        """Write a checkpoint: the EMA as `state_dict`, which the exporter reads, and under `training` the rest."""
        content = {
            "state_dict": self.ema,
            "training": {
                "weights": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "step": self.step,
                "settings": settings,
            },
        }
        with atomic_write(path) as temporary:
            torch.save(_on_cpu(content), temporary)

    def resume(self, path: Path, settings: dict[str, Any]) -> None:
        """Resume from a checkpoint of the same run; raises InputError if it is of another run, or no checkpoint."""
        check_regular(path)
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
            training: dict[str, Any] = content["training"]
        except Exception as error:  # torch.load raises errors of many types for other files
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: not a checkpoint of a training run ({reason}); choose another --out") from None
        stored = {RENAMED_SETTINGS.get(name, name): value for name, value in training["settings"].items()}
        before = DEFAULT_SETTINGS | stored
        changed = [
            f"{name} was {before.get(name)}, not {settings[name]}"
            for name in settings
            if before.get(name) != settings[name]
        ]
        if changed:
            raise InputError(
                f"{path}: belongs to a run with other settings ({', '.join(changed)}); "
                "repeat them, or choose another --out and start from this file with --init"
            )
        self.model.load_state_dict(training["weights"])
        self.optimizer.load_state_dict(training["optimizer"])
        self.ema = {name: value.to(self.device) for name, value in content["state_dict"].items()}
        self.step = training["step"]


def _on_cpu(content: Any) -> Any:
    """The same content with its tensors on the CPU, so that a computer without a GPU reads it."""
    if isinstance(content, Tensor):
        return content.cpu()
    if isinstance(content, dict):
        return {name: _on_cpu(value) for name, value in content.items()}
    return [_on_cpu(value) for value in content] if isinstance(content, list) else content


def _with_missing_parts(tensors: dict[str, Tensor], model: IDESplat) -> dict[str, Tensor]:
    """A checkpoint's tensors with the newly initialised ones of the parts that it lacks.

    Where the monocular branch is replaced, the layers that merge its features start without them.
    """
    made = model.state_dict()
    tensors = {name: made[name] for name in made if name.startswith(OPTIONAL_PREFIX)} | tensors
    if model.encoder.photo is None or any(name.startswith(PHOTO_PREFIX) for name in tensors):
        return tensors
    kept = {name: value for name, value in tensors.items() if not name.startswith(VIT_BRANCH_PREFIXES)}
    kept |= {name: made[name] for name in made if name.startswith(PHOTO_PREFIX)}
    for name in kept.keys() & MERGE_WEIGHTS:
        kept[name] = kept[name].clone()
        kept[name][:, -sum(model.config.mono_channels) :] = 0
    return kept
