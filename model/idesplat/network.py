"""IDESplat: posed photographs to depth and Gaussians in one pass.

Read beside `depthsplat.py`, which says what the two share and where they part.
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
    """The whole network; its parts are the stages that export, manifest and parity report name.

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
        """What each stage yields, in order, for parity and for training with every stage supervised."""
        cameras = Cameras(extrinsics, intrinsics, near, far)
        encoded = self.encoder(images, extrinsics)
        first = self.dpbu1(encoded, cameras)
        second = self.dpbu2(encoded, first, cameras)
        third = self.dpbu3(encoded, second, cameras)
        predicted = self.gaussians(images, cameras, encoded, (first, second, third))
        return encoded, first, second, third, predicted
