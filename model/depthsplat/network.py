"""DepthSplat: posed photographs to depth and Gaussians in one pass.

Read beside `idesplat.py`. What the two share is written once: CNN, multi-view transformer and ViT (encoder.py), the
U-Net that regularises costs (unet.py), dense prediction (dpt.py), and Gaussians from depth and raw parameters
(gaussian_adapter.py). They part where depth is found, here by sweeping planes at one scale or two (depth_stage.py),
there by attention along epipolar lines, three times over (dpbu.py); and where it is brought to image size, here by DPT
heads (upsampler.py, gaussian_regressor.py), there by window attention over shuffled pixels (gaussian_head.py).
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
        """The encoded views and what each scale yields, coarsest first."""
        encoded = self.encoder(images, cameras.extrinsics)
        if len(self.config.scales) == 1:
            return encoded, (self.depth(encoded, cameras),)
        first = self.depth1(encoded, cameras)
        return encoded, (first, self.depth2(encoded, first, cameras))


class DepthSplat(DepthScales):
    """The whole network; its parts are the stages that export, manifest and parity report name.

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
        """What each stage yields, in order, for parity and for training with every stage supervised."""
        cameras = Cameras(extrinsics, intrinsics, near, far)
        encoded, scales = self.depth_stages(images, cameras)
        return encoded, *scales, self.gaussians(images, cameras, encoded, scales)


class DepthSplatDepth(DepthScales):
    """DepthSplat without Gaussians, as the depth-only checkpoints have it: the last scale's depth is the result."""

    has_gaussians = False

    def stages(
        self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor, near: Tensor, far: Tensor
    ) -> tuple[PyramidFeatures, *tuple[DepthStageOutput, ...], DepthOutput]:
        """What each stage yields, in order, for parity and for training with every stage supervised."""
        encoded, (*before, last) = self.depth_stages(images, Cameras(extrinsics, intrinsics, near, far))
        return encoded, *before, DepthOutput(1 / last.inverse_depth_full[:, 0], last)
