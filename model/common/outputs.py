"""What a network with Gaussians returns."""

from typing import NamedTuple

from torch import Tensor

from .gaussian_adapter import WorldGaussians


class ModelOutput(NamedTuple):
    """Depth and Gaussians, and the two feature maps before them, which the parity tests compare."""

    depth: Tensor  # [views, H, W], metric z-depth
    gaussians: WorldGaussians
    features: Tensor  # [views, feature channels, H, W]
    raw: Tensor  # [views, parameters, H, W]

    def named_outputs(self) -> dict[str, Tensor]:
        """The network's outputs as exported graphs name them."""
        return {"depth": self.depth, **self.gaussians._asdict()}
