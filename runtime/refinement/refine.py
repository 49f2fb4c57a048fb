"""Per-scene refinement: Gaussians fitted to the images that they were predicted from (3D Gaussian splatting, Kerbl et al.
2023), starting from the feed-forward result, for some dozens of steps."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..splats.gaussians import Gaussians
from .losses import photometric_loss
from .rasterizer import GradientRasterizer, Parameters, Target


@dataclass(frozen=True)
class RefinementOptions:
    """What a refinement does.

    steps: of the optimiser, one view each. seconds: stops it earlier. max_opacity, scale_factor: the start, since
    saturated opacities have no gradient. lr_*: learning rates of Adam; that of the means is in units of the median depth.
    """

    steps: int = 120
    seconds: float | None = None
    seed: int = 0
    max_opacity: float = 0.6
    scale_factor: float = 1.1
    ssim_weight: float = 0.2
    lr_means: float = 2e-4
    lr_scales: float = 1e-2
    lr_quats: float = 2e-3
    lr_opacities: float = 5e-2
    lr_dc: float = 5e-3
    lr_sh: float = 1e-3
    lr_exposure: float = 0.0
    opacity_weight: float = 0.0
    scale_weight: float = 0.0
    final_lr: float = 0.1  # share of the learning rates that is left at the end


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
    exposure: np.ndarray | None = None
    contributions: np.ndarray | None = None

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
    the seed alone, not on the number of threads.
    """
    parameters = _parameters(gaussians, options)
    rasterizer = GradientRasterizer(parameters)
    lr = _learning_rates(parameters, _median_depth(parameters, views), options)
    moments = np.zeros((len(parameters), 2, parameters.columns), np.float32)
    contributions = np.zeros(len(parameters), np.float32)
    exposure = _Exposure(len(views), options.lr_exposure)
    order = _view_order(len(views), options)
    started, psnr = time.perf_counter(), []
    for step in range(options.steps):
        if options.seconds is not None and time.perf_counter() - started > options.seconds:
            break
        view = order[step]
        done = rasterizer.forward(views[view].target)
        shown = exposure.apply(view, done.rgb)
        loss = photometric_loss(shown, views[view].image, views[view].weights, options.ssim_weight)
        psnr.append(_psnr(shown, views[view]))
        gradients = rasterizer.backward(done, exposure.backward(view, done.rgb, loss.gradient))
        decay = options.final_lr ** (step / max(options.steps - 1, 1))
        rasterizer.step(
            done, gradients, moments, lr * decay, step + 1, options.opacity_weight, options.scale_weight, contributions
        )
        if report is not None and not report(step, psnr[-1]):
            break
    return Refined(_gaussians(parameters), psnr, exposure.values, contributions)


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
    depths = []
    for view in views:
        z = parameters.means @ view.viewmat[2, :3].astype(np.float32) + np.float32(view.viewmat[2, 3])
        depths.append(np.median(z[z > 0]) if (z > 0).any() else 1.0)
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


class _Exposure:
    """A gain and an offset for each view and channel, [views, 2, 3], optimised by Adam."""

    def __init__(self, views: int, lr: float) -> None:
        self.lr = lr
        self.values = np.zeros((views, 2, 3), np.float32)
        self.values[:, 0] = 1
        self._moments = np.zeros((2, views, 2, 3))
        self._counts = np.zeros(views, int)

    def apply(self, view: int, rgb: np.ndarray) -> np.ndarray:
        return rgb if self.lr == 0 else rgb * self.values[view, 0] + self.values[view, 1]

    def backward(self, view: int, rgb: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Lead the gradient of the exposed image back to the rendered one, and make a step."""
        if self.lr == 0:
            return gradient
        through = gradient * self.values[view, 0]
        given = np.stack([(gradient * rgb).sum(axis=(0, 1)), gradient.sum(axis=(0, 1))])
        self._counts[view] += 1
        first, second, count = self._moments[0, view], self._moments[1, view], self._counts[view]
        first += 0.1 * (given - first)
        second += 0.001 * (given**2 - second)
        self.values[view] -= self.lr * (first / (1 - 0.9**count)) / (np.sqrt(second / (1 - 0.999**count)) + 1e-15)
        self.values /= np.append(self.values[:, 0].mean(axis=0), np.ones(3)).reshape(2, 3)  # the mean gain stays 1
        return through
