"""The interface of every network: its stages, and the tensors that pass between them by name."""

from typing import Any

from torch import Tensor, nn

from ..config import EncoderConfig


class Network(nn.Module):
    """A network whose child modules are its stages, in the order in which they run.

    Class, graph file, manifest and parity report call a stage by the same name.
    """

    config: EncoderConfig
    # Whether it predicts Gaussians beside depth.
    has_gaussians = True

    def forward(self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor) -> Any:
        """Predict depth and, if the network has them, Gaussians: what the last stage returns.

        images: [views, 3, H, W], RGB in [0, 1]; H and W multiples of `config.size_multiple`, two views or more.
        extrinsics: [views, 4, 4], camera-to-world, OpenCV axes.
        intrinsics: [views, 3, 3], normalised by width and height.
        near, far: [views], in scene units.
        """
        return self.stages(images, extrinsics, intrinsics, near, far)[-1]

    def stages(
        self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Any, ...]:
        """What each stage returns, in order: named tuples of tensors, and last an output with `named_outputs()`."""
        raise NotImplementedError

    @property
    def stage_names(self) -> list[str]:
        """The stages' names, in order."""
        return [name for name, _ in self.named_children()]

    def named_tensors(self, *inputs: Tensor) -> dict[str, Tensor]:
        """Every tensor between stages as `stage.field`, and the network's outputs by their own names."""
        *between, last = self.stages(*inputs)
        named: dict[str, Tensor] = {}
        for stage, output in zip(self.stage_names[:-1], between, strict=True):
            named |= {f"{stage}.{field}": value for field, value in output._asdict().items()}
        return named | last.named_outputs()
