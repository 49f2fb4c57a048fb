"""The stages as data: what each reads and yields, under the names that classes, files, manifest and report share."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..model.idesplat import IDESplat
from ..runtime.bundle import INPUTS, OUTPUTS

CAMERAS = ("extrinsics", "intrinsics", "near", "far")


@dataclass(frozen=True)
class Stage:
    """One part of the network between named tensors; `encoder.features_mv` is a field of what the encoder yields."""

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


IDESPLAT_STAGES = (
    Stage(
        "encoder",
        ("images", "extrinsics"),
        (
            "encoder.neighbours",
            "encoder.features_cnn",
            "encoder.features_cnn_fine",
            "encoder.features_mv",
            "encoder.features_mono",
            "encoder.mono_out",
            "encoder.mono_disparity",
        ),
    ),
    Stage(
        "dpbu1",
        (
            "encoder.neighbours",
            "encoder.features_cnn",
            "encoder.features_mv",
            "encoder.features_mono",
            "encoder.mono_out",
            "encoder.mono_disparity",
            *CAMERAS,
        ),
        ("dpbu1.features", "dpbu1.context", "dpbu1.inverse_depth"),
    ),
    Stage(
        "dpbu2",
        (
            "encoder.neighbours",
            "encoder.features_cnn_fine",
            "encoder.features_mono",
            "encoder.mono_out",
            "dpbu1.features",
            "dpbu1.context",
            "dpbu1.inverse_depth",
            *CAMERAS,
        ),
        ("dpbu2.features", "dpbu2.context", "dpbu2.inverse_depth"),
    ),
    Stage(
        "dpbu3",
        (
            "encoder.neighbours",
            "encoder.features_cnn_fine",
            "encoder.features_mono",
            "encoder.mono_out",
            "dpbu2.features",
            "dpbu2.context",
            "dpbu2.inverse_depth",
            *CAMERAS,
        ),
        ("dpbu3.features", "dpbu3.inverse_depth", "dpbu3.probability", "dpbu3.candidates"),
    ),
    Stage(
        "gaussians",
        (
            "images",
            "encoder.features_cnn",
            "dpbu1.context",
            "dpbu1.inverse_depth",
            "dpbu2.inverse_depth",
            "dpbu3.features",
            "dpbu3.inverse_depth",
            "dpbu3.probability",
            "dpbu3.candidates",
            *CAMERAS,
        ),
        OUTPUTS,
    ),
)


class NamedTensors(nn.Module):
    """The network with every tensor that passes between stages as an output, under its name."""

    def __init__(self, model: IDESplat) -> None:
        super().__init__()
        self.model = model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return tuple(name for stage in IDESPLAT_STAGES for name in stage.outputs)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The graph's inputs, as `INPUTS` names them -> tensors as `names` names them."""
        named = self.named(*inputs)
        return tuple(named[name] for name in self.names)

    def named(self, *inputs: Tensor) -> dict[str, Tensor]:
        """The same as `forward`, by name."""
        parts = self.model.stages(*inputs)
        predicted = parts[-1]
        named = {"depth": predicted.depth, **predicted.gaussians._asdict()}
        for stage, part in zip(IDESPLAT_STAGES[:-1], parts[:-1], strict=True):
            named |= {f"{stage.name}.{field}": value for field, value in part._asdict().items()}
        return named


def example_inputs(views: int, height: int, width: int, near: float, far: float) -> dict[str, Tensor]:
    """Cameras on an arc before a textured scene, and pictures of noise at several scales: every part has work to do."""
    generator = torch.Generator().manual_seed(views)
    images = torch.zeros(views, 3, height, width)
    for size in (2, 4, 8, 16):
        noise = torch.rand(views, 3, height // size + 1, width // size + 1, generator=generator)
        images += nn.functional.interpolate(noise, (height, width), mode="bilinear", align_corners=True) / 4
    angle = torch.linspace(-0.1, 0.1, views)
    extrinsics = torch.eye(4).repeat(views, 1, 1)
    extrinsics[:, 0, 0] = extrinsics[:, 2, 2] = angle.cos()
    extrinsics[:, 0, 2], extrinsics[:, 2, 0] = -angle.sin(), angle.sin()
    extrinsics[:, 0, 3] = near * torch.linspace(-0.4, 0.4, views)
    extrinsics[:, 1, 3] = near * 0.1 * torch.rand(views, generator=generator)
    intrinsics = torch.tensor([[0.9, 0.0, 0.52], [0.0, 0.9, 0.47], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    values = (images, extrinsics, intrinsics, torch.full((views,), near), torch.full((views,), far))
    return dict(zip(INPUTS, values, strict=True))
