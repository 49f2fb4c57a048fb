"""IDESplat: posed photographs to depth and Gaussians in one pass.

Read beside `depthsplat.py`, which says what the two share and where they part.
"""

from torch import Tensor, nn

from ..common.encoder import Encoder, EncoderFeatures
from ..common.geometry import Cameras
from ..config import IDESplatConfig
from .dpbu import CoarseDPBU, DPBUOutput, RefinementDPBU
from .gaussian_head import GaussianStage, ModelOutput


class IDESplat(nn.Module):
    """The whole network; its parts are the stages that export, manifest and parity report name.

    images ── encoder ── dpbu1 ── dpbu2 ── dpbu3 ── gaussians ── depth, means, scales, quats, opacities, sh
                │  1/stride │  2/stride │  4/stride │   │
                └───────────┴───────────┴───────────┴───┘ features of CNN, multi-view transformer, ViT
    """

    def __init__(self, config: IDESplatConfig) -> None:
        super().__init__()
        self.config = config
        first, second, third = config.dpbus
        self.encoder = Encoder(config)
        self.dpbu1 = CoarseDPBU(config, first)
        self.dpbu2 = RefinementDPBU(config, second, first, context=first.channels)
        self.dpbu3 = RefinementDPBU(config, third, second, context=first.channels // 2)
        self.gaussians = GaussianStage(config)

    def forward(self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor) -> ModelOutput:
        """Predict depth and Gaussians.

        images: [views, 3, H, W], RGB in [0, 1]; H and W multiples of `config.size_multiple`, two views or more.
        extrinsics: [views, 4, 4], camera-to-world, OpenCV axes.
        intrinsics: [views, 3, 3], normalised by width and height.
        near, far: [views], in scene units.
        """
        return self.stages(images, extrinsics, intrinsics, near, far)[-1]

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
