"""All that a training run must remember: weights, their running mean, the optimiser, the step; saved whole or not."""

import math
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from ...model.checkpoint import CheckpointError, fill, read_state_dict
from ...model.idesplat.config import IDESplatConfig
from ...model.idesplat.network import IDESplat
from ...runtime.errors import InputError
from ...runtime.system.files import atomic_write, check_regular
from .gather_attention import with_compiled_products
from .initialization import new_model

# The running mean forgets at this rate, and faster in the beginning.
EMA_DECAY = 0.99
EMA_START = 10
WEIGHT_DECAY = 0.01
LARGEST_GRADIENT = 1.0
# The optimiser's groups, in this order.
BACKBONE_PREFIX = "encoder.vit."
# Weights that were trained on photographs elsewhere, and stay as they are.
FROZEN_PREFIX = "encoder.photo.network."
# Settings that earlier versions wrote under another name.
RENAMED_SETTINGS = {"gradual": "curriculum"}
# A part that older checkpoints lack. As it is made, it changes nothing.
OPTIONAL_PREFIX = "gaussians.cross_view."


class TrainingState:
    """The network in training. `step` counts the steps done."""

    def __init__(
        self, config: IDESplatConfig, seed: int, lr: float, vit_lr: float, trained: tuple[str, ...] = ("",)
    ) -> None:
        """A new network drawn from `seed`; learning rates at their highest, the ViT's and that of the rest.

        trained: the beginnings of the names of the parameters that are trained; all others are frozen.
        """
        self.model = with_compiled_products(new_model(config, seed))
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.step = 0
        for name, parameter in self.model.named_parameters():
            parameter.requires_grad_(name.startswith(trained) and not name.startswith(FROZEN_PREFIX))
        parameters = [(name, p) for name, p in self.model.named_parameters() if p.requires_grad]
        groups = [
            {"params": [p for name, p in parameters if not name.startswith(BACKBONE_PREFIX)], "highest": lr},
            {"params": [p for name, p in parameters if name.startswith(BACKBONE_PREFIX)], "highest": vit_lr},
        ]
        groups = [group for group in groups if group["params"]]
        self.optimizer = torch.optim.AdamW(groups, lr=lr, weight_decay=WEIGHT_DECAY, fused=True)

    def start_from(self, path: Path) -> None:
        """Take the weights of a checkpoint, released or own; raises InputError if it does not fit the network."""
        try:
            tensors = read_state_dict(path)
            made = self.model.state_dict()
            fill(self.model, {name: made[name] for name in made if name.startswith(OPTIONAL_PREFIX)} | tensors, path)
        except CheckpointError as error:
            raise InputError(str(error)) from None
        self.reset_ema()

    def reset_ema(self) -> None:
        """Start the running mean anew, with the weights as they are."""
        self.ema = {name: value.clone() for name, value in self.model.state_dict().items()}

    def update(self, lr_factor: float) -> float:
        """Make an optimiser step at `lr_factor` times the highest learning rates; returns the gradient's norm.

        A step whose gradient is not finite leaves the weights as they are.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = lr_factor * group["highest"]
        norm = float(nn.utils.clip_grad_norm_(self.model.parameters(), LARGEST_GRADIENT))
        if math.isfinite(norm):
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.step += 1
        decay = min(EMA_DECAY, self.step / (self.step + EMA_START))
        weights = self.model.state_dict()
        get_ema_multi_avg_fn(decay)(list(self.ema.values()), [weights[name] for name in self.ema], None)
        return norm

    def ema_model(self) -> IDESplat:
        """The network with the running mean of the weights, which predicts better than the last weights."""
        model = with_compiled_products(IDESplat(self.model.config).eval())
        model.load_state_dict(self.ema)
        return model

    def save(self, path: Path, settings: dict[str, Any]) -> None:
        """Write a checkpoint whose `state_dict` is the mean, as the exporter reads it, beside what resuming needs."""
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
            torch.save(content, temporary)

    def resume(self, path: Path, settings: dict[str, Any]) -> None:
        """Go on from a checkpoint of the same run; raises InputError for one of another run or none at all."""
        check_regular(path)
        try:
            content = torch.load(path, weights_only=True)
            training: dict[str, Any] = content["training"]
        except Exception as error:  # torch raises whatever it meets inside of a file that is not a checkpoint
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{path}: not a checkpoint of a training run ({reason}); choose another --out") from None
        before = {RENAMED_SETTINGS.get(name, name): value for name, value in training["settings"].items()}
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
        self.ema = content["state_dict"]
        self.step = training["step"]
