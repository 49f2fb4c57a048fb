"""IDESplat: posed images to depth and Gaussians in one forward pass.

depthsplat/network.py says what the two networks share and where they differ.
"""

from torch import Tensor

from ..common.geometry import Cameras
from ..common.network import Network
from ..common.outputs import ModelOutput
from .config import IDESplatConfig
from .dpbu import CoarseDPBU, DPBUOutput, RefinementDPBU
from .encoder import Encoder, EncoderFeatures
from .gaussian_head import GaussianStage


class IDESplat(Network):
    """The network. Its child modules are the stages, by the names of graph files, manifest and parity report.

    images ── encoder ── dpbu1 ── dpbu2 ── dpbu3 ── gaussians ── depth, means, scales, quats, opacities, sh
                │  1/stride │  2/stride │  4/stride │   │
                └───────────┴───────────┴───────────┴───┘ features of CNN, multi-view transformer, ViT
    """

    config: IDESplatConfig

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__()
        self.config = config
        first, second, third = config.dpbus
        self.encoder = Encoder(config)
        self.dpbu1 = CoarseDPBU(config, first)
        self.dpbu2 = RefinementDPBU(config, second, first, context=first.channels)
        self.dpbu3 = RefinementDPBU(config, third, second, context=first.channels // 2)
        self.gaussians = GaussianStage(config)

    def stages(
        self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor
    ) -> tuple[EncoderFeatures, DPBUOutput, DPBUOutput, DPBUOutput, ModelOutput]:
        """What each stage returns, in order, for parity and for training with every stage supervised."""
        cameras = Cameras(extrinsics, intrinsics, near, far)
        encoded = self.encoder(images, extrinsics)
        first = self.dpbu1(encoded, cameras)
        second = self.dpbu2(encoded, first, cameras)
        third = self.dpbu3(encoded, second, cameras)
        output = self.gaussians(images, cameras, encoded, (first, second, third))
        return encoded, first, second, third, output
