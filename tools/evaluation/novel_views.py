"""Evaluation of one case: target views rendered from a model's Gaussians, and compared with the baselines."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ...runtime.geometry.rigid import invert_rigid
from ...runtime.images.colormaps import colormap_depth
from ...runtime.inference.predictor import Predictor
from ...runtime.rendering.rasterizer import rasterize
from ...runtime.rendering.types import Rendering
from ...runtime.splats.gaussians import Gaussians
from .baselines import best_fronto_parallel_plane, nearest_view, oracle_depth_splats
from .cases import EvalCase, PosedImages
from .metrics import PerceptualMetric, depth_measures, psnr, ssim

MODEL, NEAREST, ORACLE_PLANE, ORACLE_DEPTH = "model", "nearest", "oracle_plane", "oracle_depth"
# Default near plane of target renderings, in scene units.
NEAR_PLANE = 0.01
# Mean absolute colour error at the top of the error image's colour map.
MAX_ERROR = 0.3
# No depth is shown below this alpha.
MIN_ALPHA = 0.05
GAP = 4  # white pixels between the images of a strip

# Metrics by method.
Scores = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Target:
    """Metrics of a target view by method.

    details: `nearest_view`, its name, and `oracle_plane_depth` in scene units.
    """

    name: str
    scores: Scores
    details: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """Metrics of a case; depth: AbsRel, delta < 1.25 and inlier ratio, where the context's true depth is known."""

    name: str
    context: list[str]
    near: float
    far: float
    targets: list[Target]
    depth: dict[str, float]


@dataclass(frozen=True)
class Evaluator:
    """Evaluates a model on cases.

    perceptual: distances by name. compare: whether the baselines are evaluated, too.
    near_plane: of target renderings, in scene units.
    """

    predictor: Predictor
    perceptual: Mapping[str, PerceptualMetric]
    compare: bool = True
    near_plane: float = NEAR_PLANE

    def evaluate(self, case: EvalCase, show: Callable[[str, np.ndarray], None] | None = None) -> Result:
        """Predict from the context, render the targets and compute their metrics.

        show: receives each target's name and strip: truth, render, error, depth and, if evaluated, the oracle plane,
        side by side, RGB in [0, 1]. Raises InputError for a case that the model cannot take.
        """
        given = case.context
        prediction = self.predictor.predict_arrays(
            given.images, given.extrinsics, given.intrinsics, case.near, case.far
        )
        exact = None
        if self.compare and case.depth is not None and (case.depth > 0).all():
            exact = oracle_depth_splats(case.depth, given)
        targets = []
        for view, name in enumerate(case.targets.names):
            truth, valid = case.targets.image(view), case.targets.valid[view]
            rendering = render_target(prediction.need_gaussians(), case.targets, view, self.near_plane)
            images: dict[str, np.ndarray] = {MODEL: rendering.rgb}
            details: dict[str, Any] = {}
            if self.compare:
                baselines, details = self._baselines(case, view, exact)
                images |= baselines
            covisible = None if case.covisible is None else case.covisible[view] & valid
            scores = {method: self._measure(image, truth, valid, covisible) for method, image in images.items()}
            targets.append(Target(name, scores, details))
            if show is not None:
                show(name, comparison_strip(truth, valid, rendering, images.get(ORACLE_PLANE)))
        depth = {} if case.depth is None else depth_measures(prediction.depth, case.depth, case.matched)
        return Result(case.name, given.names, case.near, case.far, targets, depth)

    def _baselines(
        self, case: EvalCase, view: int, exact: Gaussians | None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The baselines' images of a target, [height, width, 3], and details; exact: oracle-depth splats."""
        context, targets, pose = case.context, case.targets, case.targets.extrinsics[view]
        copied = nearest_view(context, pose)
        truth, valid = targets.image(view), targets.valid[view]
        plane, depth = best_fronto_parallel_plane(context, truth, valid, pose, targets.K(view), case.near, case.far)
        images = {NEAREST: context.image(copied), ORACLE_PLANE: plane}
        if exact is not None:
            images[ORACLE_DEPTH] = render_target(exact, targets, view, self.near_plane).rgb
        return images, {"nearest_view": context.names[copied], "oracle_plane_depth": depth}

    def _measure(
        self, image: np.ndarray, truth: np.ndarray, valid: np.ndarray, covisible: np.ndarray | None
    ) -> dict[str, float]:
        scores = {"psnr": psnr(image, truth, valid), "ssim": ssim(image, truth, valid)}
        if covisible is not None:
            scores["psnr_covisible"] = psnr(image, truth, covisible)
        return scores | {name: metric(image, truth, valid) for name, metric in self.perceptual.items()}


def mean_of_views(results: Sequence[Result]) -> Scores:
    """Metrics of every method averaged over all target views; depth metrics of the model averaged over the scenes."""
    means = _mean([target.scores for result in results for target in result.targets])
    means[MODEL] |= _mean([{MODEL: result.depth} for result in results])[MODEL]
    return means


def mean_of_scenes(results: Sequence[Result]) -> Scores:
    """As in the papers: the mean over scenes of each scene's mean over its target views."""
    return _mean([mean_of_views([result]) for result in results])


def render_target(gaussians: Gaussians, targets: PosedImages, view: int, near_plane: float = NEAR_PLANE) -> Rendering:
    """Render Gaussians from a target camera at its image's size, on black; near_plane in scene units."""
    height, width = targets.images.shape[2:]
    return rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        invert_rigid(targets.extrinsics[view]),
        targets.K(view),
        width,
        height,
        near=near_plane,
    )


def _mean(entries: list[Scores]) -> Scores:
    """The mean of entries; of each method and metric over those that have it."""
    means: Scores = {}
    for method in dict.fromkeys(method for entry in entries for method in entry):
        found = [entry[method] for entry in entries if method in entry]
        means[method] = {
            measure: float(np.mean([scores[measure] for scores in found if measure in scores]))
            for measure in dict.fromkeys(measure for scores in found for measure in scores)
        }
    return means


def comparison_strip(
    truth: np.ndarray, valid: np.ndarray, rendering: Rendering, plane: np.ndarray | None
) -> np.ndarray:
    """Truth, render, error (black at invalid pixels), depth and oracle plane side by side, [height, all widths, 3]."""
    error = np.abs(rendering.rgb.clip(0, 1) - truth).mean(axis=2) * valid / MAX_ERROR
    hot = cv2.applyColorMap(np.rint(255 * error.clip(0, 1)).astype(np.uint8), cv2.COLORMAP_INFERNO)
    depth = np.where(rendering.alpha > MIN_ALPHA, rendering.depth / np.maximum(rendering.alpha, MIN_ALPHA), 0)
    images = [truth, rendering.rgb, hot[..., ::-1].astype(np.float32) / 255, colormap_depth(depth)]
    if plane is not None:
        images.append(plane)
    white = np.ones((len(truth), GAP, 3), np.float32)
    return np.concatenate([part for image in images for part in (white, image)][1:], axis=1)
