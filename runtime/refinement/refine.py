"""Per-scene refinement: Gaussians fitted to posed images, as in 3D Gaussian splatting (Kerbl et al. 2023).

It starts from a finished scene, such as a feed-forward prediction, and makes some dozens of steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..splats.gaussians import Gaussians
from ..system.progress import progress
from .losses import photometric_loss
from .rasterizer import GradientRasterizer, Parameters, Target

MAX_TRANSMITTANCE = 0.5  # of a pixel that counts as covered


@dataclass(frozen=True)
class RefinementOptions:
    """What a refinement does.

    steps: of the optimiser, one view each. seed: of the order of the views.
    max_opacity, scale_factor: limit the opacities and enlarge the scales at the start: saturated opacities have almost
    no gradient, and lower ones leave gaps between splats.
    ssim_weight: of 1 - SSIM against L1. lr_*: learning rates of Adam; of the means, relative to the median depth.
    final_lr: what is left of the learning rates at the end, as they decay exponentially.
    """

    steps: int = 120
    seed: int = 0
    max_opacity: float = 0.8
    scale_factor: float = 1.1
    ssim_weight: float = 0.2
    lr_means: float = 2e-4
    lr_scales: float = 1e-2
    lr_quats: float = 2e-3
    lr_opacities: float = 5e-2
    lr_dc: float = 5e-3
    lr_sh: float = 1e-3
    final_lr: float = 0.1


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image to fit: RGB in [0, 1] float32 [height, width, 3], world-to-camera [4, 4], K in pixels [3, 3].

    weights: of the pixels, [height, width, 1] float32; zero where the camera saw nothing.
    """

    image: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    weights: np.ndarray

    @property
    def target(self) -> Target:
        """The view to render."""
        height, width = self.image.shape[:2]
        return Target(np.asarray(self.viewmat, np.float64), np.asarray(self.K, np.float64), width, height)


@dataclass(eq=False)
class Refined:
    """A refined scene. psnr: of the views before their step, one for each step. steps: that were made."""

    gaussians: Gaussians
    psnr: list[float] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """Steps that were made."""
        return len(self.psnr)


def refine(
    gaussians: Gaussians,
    views: Sequence[PosedImage],
    options: RefinementOptions = RefinementOptions(),
    report: Callable[[int, float], bool] | None = None,
) -> Refined:
    """Fit Gaussians to posed images by Adam on (1 - w) L1 + w (1 - SSIM), one view a step.

    report: is told the step and the view's PSNR, and stops the refinement by returning False. The result depends on
    the seed alone, not on the number of threads. Pixels that the scene does not cover at the start have no weight, so
    that no Gaussian is stretched to fill them.
    """
    parameters = _parameters(gaussians, options)
    rasterizer = GradientRasterizer(parameters)
    lr = _learning_rates(parameters, _median_depth(parameters, views), options)
    moments = np.zeros((len(parameters), 2, parameters.columns), np.float32)
    order = _view_order(len(views), options)
    views = [_covered(rasterizer, view) for view in progress(views, "finding what the scene covers")]
    psnr: list[float] = []
    for step in progress(range(options.steps), "refining"):
        view = views[order[step]]
        done = rasterizer.forward(view.target)
        loss = photometric_loss(done.rgb, view.image, view.weights, options.ssim_weight)
        psnr.append(_psnr(done.rgb, view))
        gradients = rasterizer.backward(done, loss.gradient)
        decay = options.final_lr ** (step / max(options.steps - 1, 1))
        rasterizer.step(done, gradients, moments, lr * decay, step + 1)
        if report is not None and not report(step, psnr[-1]):
            break
    return Refined(_gaussians(parameters), psnr)


def _covered(rasterizer: GradientRasterizer, view: PosedImage) -> PosedImage:
    """The view with weight 0 where less than half of the light is stopped by the scene."""
    covered = rasterizer.forward(view.target).transmittance < MAX_TRANSMITTANCE
    return replace(view, weights=view.weights * covered[..., None])


def _parameters(gaussians: Gaussians, options: RefinementOptions) -> Parameters:
    opacities = np.clip(gaussians.opacities, 1e-4, options.max_opacity).astype(np.float64)
    scales = np.maximum(gaussians.scales.astype(np.float64) * options.scale_factor, 1e-12)
    arrays = (gaussians.means, gaussians.quats, np.log(scales), np.log(opacities / (1 - opacities)), gaussians.sh)
    return Parameters(*(np.array(array, np.float32, order="C") for array in arrays))


def _gaussians(parameters: Parameters) -> Gaussians:
    p = parameters
    quats = p.quats / np.maximum(np.linalg.norm(p.quats, axis=1, keepdims=True), 1e-12)
    opacities = 1 / (1 + np.exp(-p.logits.astype(np.float64)))
    return Gaussians(p.means, np.exp(p.log_scales), quats.astype(np.float32), opacities.astype(np.float32), p.sh)


def _median_depth(parameters: Parameters, views: Sequence[PosedImage]) -> float:
    depths: list[float] = []
    for view in views:
        z = parameters.means @ view.viewmat[2, :3].astype(np.float32) + np.float32(view.viewmat[2, 3])
        depths.append(float(np.median(z[z > 0])) if (z > 0).any() else 1.0)
    return float(np.median(depths))


def _learning_rates(parameters: Parameters, depth: float, options: RefinementOptions) -> np.ndarray:
    lr = np.empty(parameters.columns)
    lr[:3], lr[3:7], lr[7:10] = options.lr_means * depth, options.lr_quats, options.lr_scales
    lr[10], lr[11:14], lr[14:] = options.lr_opacities, options.lr_dc, options.lr_sh
    return lr


def _view_order(views: int, options: RefinementOptions) -> list[int]:
    """The view of each step: every view once before any comes again."""
    generator = np.random.default_rng(options.seed)
    rounds = -(-options.steps // views)
    return [int(view) for _ in range(rounds) for view in generator.permutation(views)]


def _psnr(image: np.ndarray, view: PosedImage) -> float:
    weights = view.weights
    error = float((np.square(image - view.image) * weights).sum()) / max(3 * float(weights.sum()), 1.0)
    return -10 * float(np.log10(error + 1e-12))
