"""Per-scene refinement: Gaussians fitted to posed images, as in 3D Gaussian splatting (Kerbl et al. 2023).

It starts from a finished scene, such as a feed-forward prediction, and makes some dozens of steps.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..splats.gaussians import Gaussians
from ..system.progress import progress
from .contributions import Contributions, strongest
from .directions import view_directions
from .losses import photometric_loss
from .options import RefinementOptions
from .poses import move_world
from .rasterizer import GradientRasterizer, Parameters, Pass, Target, compile_all
from .view_adam import ViewAdam

LEAST_OPACITY, MOST_OPACITY, LEAST_SCALE = 1e-4, 1 - 1e-7, 1e-12  # whose logits and logarithms are finite
MAX_TRANSMITTANCE = 0.5  # of a pixel that counts as covered
DEFAULT = RefinementOptions()
COARSE = 3.0  # times the median size in the images, from where a Gaussian is one of a backdrop
PRUNE_AFTER = 0.6  # of the steps or the time, so that the others make up for what is removed


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image to fit: RGB in [0, 1] float32 [height, width, 3], world-to-camera [4, 4], K in pixels [3, 3].

    valid: the pixels to fit, bool [height, width]; not those that the camera did not see.
    """

    image: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    valid: np.ndarray

    @property
    def weights(self) -> np.ndarray:
        """Of the pixels in the loss, float32 [height, width, 1]."""
        return self.valid[..., None].astype(np.float32)

    @property
    def target(self) -> Target:
        """The view to render."""
        height, width = self.image.shape[:2]
        return Target(np.asarray(self.viewmat, np.float64), np.asarray(self.K, np.float64), width, height)


@dataclass(eq=False)
class Refined:
    """A refined scene.

    psnr: of the views before their step, one for each step; NaN of a view that has no pixel to fit. gains, offsets: of
    each view and channel, [views, 3]: an image is gain * render + offset. viewmats: of the views, refined if asked for,
    [views, 4, 4].
    """

    gaussians: Gaussians
    psnr: list[float]
    gains: np.ndarray
    offsets: np.ndarray
    viewmats: np.ndarray

    @property
    def steps(self) -> int:
        """Steps that were made."""
        return len(self.psnr)

    def mean_psnr(self) -> tuple[float, float]:
        """The means of the first and of the last step of each view; NaN where no view has a pixel to fit."""
        views = len(self.viewmats)
        first, last = self.psnr[:views], self.psnr[-views:]
        return _mean_of_known(first), _mean_of_known(last)


def refine(
    gaussians: Gaussians,
    views: Sequence[PosedImage],
    options: RefinementOptions = DEFAULT,
    report: Callable[[int, float], bool] | None = None,
) -> Refined:
    """Fit Gaussians to posed images by Adam on (1 - w) L1 + w (1 - SSIM), one view a step.

    report: is told the step and the view's PSNR, and stops the refinement by returning False. The result depends on
    the seed alone, not on the number of threads, unless `options.seconds` ends it. Pixels that the scene does not cover
    when a view has its first turn have no weight, so that no Gaussian is stretched to fill them.
    """
    compile_all()
    started = time.perf_counter()
    optimiser = Optimiser(gaussians, views, options)
    order = _view_order(len(views), options.seed)
    psnr: list[float] = []
    pruned = not (options.max_gaussians or options.min_opacity)
    for step in progress(range(options.steps), "refining", detail=lambda: f"{psnr[-1]:.1f} dB" if psnr else ""):
        elapsed = (time.perf_counter() - started) / options.seconds
        if elapsed >= 1:
            break
        done = max(step / max(options.steps - 1, 1), elapsed)
        if not pruned and done >= PRUNE_AFTER and step >= len(views):  # what no view shows yet, the next may need
            optimiser.prune(options.max_gaussians)
            pruned = True
        psnr.append(optimiser.step(next(order), options.final_lr**done))
        if report is not None and not report(step, psnr[-1]):
            break
    optimiser.prune(options.max_gaussians)
    viewmats = np.stack([view.viewmat for view in optimiser.views])
    return Refined(_gaussians(optimiser.parameters), psnr, optimiser.gains, optimiser.offsets, viewmats)


class Optimiser:
    """Gaussians and the views' exposures, with their moments and learning rates."""

    def __init__(self, gaussians: Gaussians, views: Sequence[PosedImage], options: RefinementOptions) -> None:
        self.options = options
        self.parameters = _parameters(gaussians, views, options)
        self.rasterizer = GradientRasterizer(self.parameters)
        self.depth = _median_depth(self.parameters, views)
        directions = view_directions(self.parameters.means, [view.target for view in views])
        self.directions = directions.means
        slope = max(1 - 2 / len(views), 0) / directions.spread  # colours of two views are on a line, whatever they are
        self.lr = _learning_rates(self.parameters, self.depth, slope, options)
        self.moments = np.zeros((len(self.parameters), 2, self.parameters.columns), np.float32)
        self.views = list(views)
        self.gains, self.offsets = np.ones((len(views), 3)), np.zeros((len(views), 3))
        self.exposure_adam, self.pose_adam = ViewAdam(len(views), 6), ViewAdam(len(views), 6)
        self.contributions = Contributions(len(self.parameters), len(views))
        self.steps = 0

    def step(self, index: int, lr: float) -> float:
        """One step on one view, with this factor on all learning rates; the view's PSNR before it."""
        done = self.rasterizer.forward(self.views[index].target)
        if not self.exposure_adam.visits[index]:
            self.views[index] = covered(self.views[index], done)
        view = self.views[index]
        gain, offset = (values[index].astype(np.float32) for values in (self.gains, self.offsets))
        rendered = done.rgb * gain + offset
        loss = photometric_loss(rendered, view.image, view.weights, self.options.ssim_weight)
        gradients = self.rasterizer.backward(done, loss.gradient * gain)
        self._add_contributions(done, gradients)
        self.steps += 1
        if self.options.lr_poses:
            self._step_pose(index, self.rasterizer.pose_gradient(done, gradients), lr)
        decay, growth = self.options.opacity_decay * lr, self.options.scale_growth * lr
        self.rasterizer.step(done, gradients, self.moments, self.lr * lr, self.steps, self.directions, decay, growth)
        self._step_exposure(index, loss.gradient, done.rgb, lr)
        return _psnr(rendered, view)

    def prune(self, limit: int) -> None:
        """Keep the Gaussians that contribute most, at most `limit` or any number for 0.

        None that adds nothing, and none below the least opacity of the options. Views that had no turn yet are rendered
        for it: what they alone show stays.
        """
        if self.steps < len(self.views):
            waiting = [view for view, visits in zip(self.views, self.exposure_adam.visits, strict=True) if not visits]
            for view in progress(waiting, "finding what contributes"):
                done = self.rasterizer.forward(view.target)
                self._add_contributions(done, self.rasterizer.backward(done, np.zeros_like(done.rgb)))
        total = self.contributions.total
        chosen = strongest(np.where(self._faint(), 0, total), limit or len(total))
        if len(chosen) < len(total):
            self.parameters = self.parameters.select(chosen)
            self.moments, self.directions = self.moments[chosen], self.directions[chosen]
            self.contributions.keep(chosen)
            self.rasterizer = GradientRasterizer(self.parameters)

    def _faint(self) -> np.ndarray:
        """The Gaussians below the least opacity, bool [gaussians]; none, if all are."""
        faint = _opacities(self.parameters) < self.options.min_opacity
        return faint & (not faint.all())

    def _add_contributions(self, done: Pass, gradients: np.ndarray) -> None:
        self.contributions.add(self.rasterizer.weights(done, gradients), done.boxes[:, 3] > done.boxes[:, 2])

    def _step_exposure(self, index: int, for_image: np.ndarray, rgb: np.ndarray, lr: float) -> None:
        """Adam on a view's gains and offsets. The mean over the views stays 1 and 0: else the scene would drift."""
        gradient = np.concatenate([(for_image * rgb).sum((0, 1)), for_image.sum((0, 1))]).astype(np.float64)
        step = self.options.lr_exposure * lr * self.exposure_adam.direction(index, gradient)
        self.gains[index] -= step[:3]
        self.offsets[index] -= step[3:]
        self.gains /= self.gains.mean(axis=0)
        self.offsets -= self.offsets.mean(axis=0)

    def _step_pose(self, index: int, gradient: np.ndarray, lr: float) -> None:
        """Adam on a view's pose; the translation's learning rate is relative to the median depth."""
        motion = -self.options.lr_poses * lr * self.pose_adam.direction(index, gradient)
        motion[3:] *= self.depth
        self.views[index] = replace(self.views[index], viewmat=move_world(self.views[index].viewmat, motion))


def covered(view: PosedImage, done: Pass) -> PosedImage:
    """The view without the pixels where less than half of the light is stopped by the scene."""
    return replace(view, valid=view.valid & (done.transmittance < MAX_TRANSMITTANCE))


def as_parameters(gaussians: Gaussians, opacities: np.ndarray, scales: np.ndarray) -> Parameters:
    """The Gaussians as the rasteriser takes them, with these opacities and scales."""
    opacities = np.clip(opacities.astype(np.float64), LEAST_OPACITY, MOST_OPACITY)
    log_scales = np.log(np.maximum(scales.astype(np.float64), LEAST_SCALE))
    arrays = (gaussians.means, gaussians.quats, log_scales, np.log(opacities / (1 - opacities)), gaussians.sh)
    return Parameters(*(np.array(array, np.float32, order="C") for array in arrays))


def _parameters(gaussians: Gaussians, views: Sequence[PosedImage], options: RefinementOptions) -> Parameters:
    """The Gaussians as they start. A backdrop keeps its opacity: nothing behind it should show, least of all black."""
    most = np.where(_coarse(gaussians, views), max(DEFAULT.max_opacity, options.max_opacity), options.max_opacity)
    return as_parameters(gaussians, np.minimum(gaussians.opacities, most), gaussians.scales * options.scale_factor)


def _coarse(gaussians: Gaussians, views: Sequence[PosedImage]) -> np.ndarray:
    """The Gaussians that are COARSE times as large in the images as most, by their shortest axis, bool [gaussians]."""
    shortest, sizes = gaussians.scales.min(axis=1), np.full(len(gaussians.means), np.inf, np.float32)
    for view in views:
        z = _depths(gaussians.means, view)
        seen = z > 0
        sizes[seen] = np.minimum(sizes[seen], shortest[seen] / z[seen])
    return sizes > COARSE * np.median(sizes) if len(sizes) else np.zeros(0, bool)


def _gaussians(parameters: Parameters) -> Gaussians:
    p = parameters
    quats = p.quats / np.maximum(np.linalg.norm(p.quats, axis=1, keepdims=True), 1e-12)
    return Gaussians(p.means, np.exp(p.log_scales), quats.astype(np.float32), _opacities(p).astype(np.float32), p.sh)


def _opacities(parameters: Parameters) -> np.ndarray:
    return 1 / (1 + np.exp(-parameters.logits.astype(np.float64)))


def _median_depth(parameters: Parameters, views: Sequence[PosedImage]) -> float:
    depths: list[float] = []
    for view in views:
        z = _depths(parameters.means, view)
        depths.append(float(np.median(z[z > 0])) if (z > 0).any() else 1.0)
    return float(np.median(depths))


def _depths(means: np.ndarray, view: PosedImage) -> np.ndarray:
    """The z-depth of means [gaussians, 3] in a view, [gaussians]."""
    return means @ view.viewmat[2, :3].astype(np.float32) + np.float32(view.viewmat[2, 3])


def _learning_rates(parameters: Parameters, depth: float, slope: float, options: RefinementOptions) -> np.ndarray:
    lr = np.empty(parameters.columns)
    lr[:3], lr[3:7], lr[7:10] = options.lr_means * depth, options.lr_quats, options.lr_scales
    lr[10], lr[11:14], lr[14:23], lr[23:] = options.lr_opacities, options.lr_dc, options.lr_sh_1 * slope, options.lr_sh
    return lr


def _view_order(views: int, seed: int) -> Iterator[int]:
    """The view of each step: every view once before any comes again."""
    generator = np.random.default_rng(seed)
    while True:
        yield from generator.permutation(views).tolist()


def _mean_of_known(values: Sequence[float]) -> float:
    return float(np.mean([value for value in values if not np.isnan(value)] or [np.nan]))


def _psnr(image: np.ndarray, view: PosedImage) -> float:
    """Over the pixels that are fitted; NaN where there is none."""
    weights = view.weights
    if not weights.any():
        return float("nan")
    error = float((np.square(image - view.image) * weights).sum()) / (3 * float(weights.sum()))
    return -10 * float(np.log10(error + 1e-12))
