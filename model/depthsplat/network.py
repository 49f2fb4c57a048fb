"""DepthSplat: posed images to depth and Gaussians in one forward pass.

It shares with IDESplat, in model/common: CNN, multi-view transformer and ViT (encoder.py), the U-Net that regularises
costs (unet.py), dense prediction (dpt.py), and Gaussians from depth and raw parameters (gaussian_adapter.py). The two
differ in depth estimation: a plane-sweep cost volume at one or two scales here (depth_stage.py), three DPBUs of
epipolar attention there (dpbu.py). They also differ in upsampling: DPT heads here (upsampler.py,
gaussian_regressor.py), window attention over unshuffled pixels there (gaussian_head.py).
"""

from torch import Tensor

from ..common.geometry import Cameras
from ..common.network import Network
from ..common.outputs import ModelOutput
from .config import DepthSplatConfig
from .depth_stage import CoarseDepth, DepthOutput, DepthStageOutput, FineDepth
from .encoder import PyramidEncoder, PyramidFeatures
from .gaussian_regressor import GaussianRegressor


class DepthScales(Network):
    """The stages up to the depth, with one scale or two."""

    config: DepthSplatConfig

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = PyramidEncoder(config)
        if len(config.scales) == 1:
            self.depth = CoarseDepth(config)
        else:
            self.depth1 = CoarseDepth(config)
            self.depth2 = FineDepth(config)

    def depth_stages(self, images: Tensor, cameras: Cameras) -> tuple[PyramidFeatures, tuple[DepthStageOutput, ...]]:
        """The encoder's features and what each scale returns, coarsest first."""
        encoded = self.encoder(images, cameras.extrinsics)
        if len(self.config.scales) == 1:
            return encoded, (self.depth(encoded, cameras),)
        first = self.depth1(encoded, cameras)
        return encoded, (first, self.depth2(encoded, first, cameras))


class DepthSplat(DepthScales):
    """The network. Its child modules are the stages, by the names of graph files, manifest and parity report.

    images ── encoder ── depth1 ── depth2 ── gaussians ── depth, means, scales, quats, opacities, sh
                 │  1/stride │  2/stride │     │
                 └───────────┴───────────┴─────┘ features of CNN, multi-view transformer, ViT

    With one scale, `depth` stands in the place of `depth1` and `depth2`.
    """

    def __init__(self, config: DepthSplatConfig) -> None:
        super().__init__(config)
        self.gaussians = GaussianRegressor(config)

    def stages(
        self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor
    ) -> tuple[PyramidFeatures, *tuple[DepthStageOutput, ...], ModelOutput]:
        """What each stage returns, in order, for parity and for training with every stage supervised."""
        cameras = Cameras(extrinsics, intrinsics, near, far)
        encoded, scales = self.depth_stages(images, cameras)
        return encoded, *scales, self.gaussians(images, cameras, encoded, scales)


class DepthSplatDepth(DepthScales):
    """DepthSplat without Gaussians, for the depth-only checkpoints: the output is the last scale's depth."""

    has_gaussians = False

    def stages(
        self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor
    ) -> tuple[PyramidFeatures, *tuple[DepthStageOutput, ...], DepthOutput]:
        """What each stage returns, in order, for parity and for training with every stage supervised."""
        encoded, (*before, last) = self.depth_stages(images, Cameras(extrinsics, intrinsics, near, far))
        return encoded, *before, DepthOutput(1 / last.inverse_depth_full[:, 0], last)
