"""Evaluation of one capture: held-out frames rendered from pairs of views and from longer windows of views."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ....runtime.cameras.undistortion import UndistortedImage
from ....runtime.images.colormaps import to_uint8
from ....runtime.inference.predictor import Predictor
from ....runtime.reconstruction.many_views import predict_views
from ....runtime.reconstruction.steps import Plan, fuse, refine_prediction
from ....runtime.splats.gaussians import Gaussians
from ....runtime.system.progress import reporting_to
from ....runtime.views.batch import ViewBatch
from ....runtime.views.depth_range import DepthRange
from ....runtime.views.exposure import Exposure, compensate_exposure
from ....runtime.views.exposure_mode import ExposureMode
from ..baselines import best_fronto_parallel_plane, nearest_view
from ..cases import EvalCase, PosedImages
from ..metrics import PerceptualMetric, fit_exposure, psnr, ssim
from ..novel_views import MODEL, NEAREST, ORACLE_PLANE, Scores, comparison_strip, render_target
from .capture import PAIR, Capture, CaptureImages

INTERPOLATED = "psnr_interpolated_exposure"
OWN_EXPOSURE = "input_psnr_own_exposure"
PAIRS = "pairs"  # method: the model given the two views around each held-out frame

Show = Callable[[str, np.ndarray], None]


@dataclass(frozen=True, eq=False)
class Scene:
    """The Gaussians as `reconstruct` makes them of context views, and the seconds that it takes.

    exposure: from each context view to the Gaussians' common exposure.
    """

    gaussians: Gaussians
    exposure: Exposure
    seconds: float

    def in_exposure_of(self, image: np.ndarray, views: Sequence[int]) -> np.ndarray:
        """A render in the mean of these context views' exposures, [height, width, 3].

        With automatic exposure, a camera takes a frame between two others about so.
        """
        return np.mean([self.exposure.undo(image, view) for view in views], axis=0)


@dataclass(frozen=True)
class TargetScores:
    """The metrics of a held-out frame, by method and metric."""

    name: str
    scores: Scores


@dataclass(frozen=True)
class CaseScores:
    """One prediction: its context, the held-out frames, and its context frames rendered from all its Gaussians.

    input_psnr: of context frames in the Gaussians' common exposure. input_psnr_own_exposure: of each in its own.
    left_out: frames of the window that are not in the context, since the checks of images find a defect.
    """

    context: list[str]
    targets: list[TargetScores]
    input_psnr: float
    input_psnr_own_exposure: float
    seconds: float
    left_out: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class CaptureScores:
    """The metrics of a capture, by the number of context views; without numbers that it has too few views for."""

    name: str
    kind: str
    cases: dict[int, list[CaseScores]] = field(default_factory=dict)

    def mean(self, count: int) -> Scores:
        """The mean over the held-out frames by method and metric, and of the input views' PSNR over the cases."""
        cases = self.cases[count]
        targets = [target.scores for case in cases for target in case.targets]
        means = {
            method: {name: float(np.mean([scores[method][name] for scores in targets])) for name in metrics}
            for method, metrics in targets[0].items()
        }
        means[MODEL]["input_psnr"] = float(np.mean([case.input_psnr for case in cases]))
        means[MODEL][OWN_EXPOSURE] = float(np.mean([case.input_psnr_own_exposure for case in cases]))
        return means


class CaptureEvaluator:
    """Evaluates a model on captures; perceptual: distances by name. plan: what follows the prediction.

    exposure: what to do about differences of exposure between the context views.
    """

    def __init__(
        self,
        predictor: Predictor,
        perceptual: Mapping[str, PerceptualMetric],
        plan: Plan,
        exposure: ExposureMode = ExposureMode.AUTO,
    ) -> None:
        self.predictor, self.perceptual, self.plan, self.exposure = predictor, perceptual, plan, exposure

    def evaluate(
        self, capture: Capture, images: CaptureImages, counts: Sequence[int], show: Show | None = None
    ) -> CaptureScores:
        """The capture's triples if `counts` has 2, and its middle views for every other number of views.

        Windows of views are compared with the nearest view and the best fronto-parallel plane (oracle) of the two views
        around each held-out frame, and with the model given these two. Views with defects are left out, as by
        `idesplat infer`, and with them the held-out frames on either side.
        show: receives a name and a strip for each held-out frame: truth, render, error, depth and plane.
        Raises InputError for what the model cannot take.
        """
        result = CaptureScores(capture.name, capture.kind)
        pairs: dict[str, Scores] = {}
        for count in counts:
            if count == PAIR:
                result.cases[count] = [
                    self._triple(images.case(triple.context, [triple.target], self.predictor.depth_range), show)
                    for triple in capture.triples
                ]
                continue
            window, between = capture.window(count)
            context = images.without_defects(window) if window else []
            triples = [triple for triple in map(capture.neighbours, between) if set(triple.context) <= set(context)]
            if not triples:
                continue
            for triple in triples:
                if triple.target not in pairs:
                    case = images.case(triple.context, [triple.target], self.predictor.depth_range)
                    pairs[triple.target] = self._triple(case, None).targets[0].scores
            case = images.case(context, [triple.target for triple in triples], self.predictor.depth_range)
            around = [[context.index(name) for name in triple.context] for triple in triples]
            left_out = [name for name in window if name not in context]
            result.cases[count] = [replace(self._window(case, around, pairs, show), left_out=left_out)]
        return result

    def predict(self, case: EvalCase) -> Scene:
        """The scene of the context views, without what the command prints."""
        views, span = _view_batch(case.context), DepthRange(case.near, case.far, "given")
        started = time.perf_counter()
        with reporting_to(None):
            views, exposure = compensate_exposure(views, self.exposure)
            prediction = predict_views(self.predictor, views, span, for_fusion=self.plan.fuses)
            prediction = fuse(prediction, views, span, self.plan).prediction
            if self.plan.copy_side:
                refined = refine_prediction(prediction, views, self.plan, None)
                prediction = refined.prediction
                exposure = exposure.then(refined.exposure) if refined.exposure else exposure
        return Scene(prediction.need_gaussians(), exposure, time.perf_counter() - started)

    def _triple(self, case: EvalCase, show: Show | None) -> CaseScores:
        """Evaluate a pair of views and one held-out frame, with the baselines."""
        scene = self.predict(case)
        pose, K = case.targets.extrinsics[0], case.targets.K(0)
        truth, valid = case.targets.image(0), case.targets.valid[0]
        plane, _ = best_fronto_parallel_plane(case.context, truth, valid, pose, K, case.near, case.far)
        rendering = render_target(scene.gaussians, case.targets, 0)
        nearest = case.context.image(nearest_view(case.context, pose))
        scores = {
            MODEL: self._measure_scene(scene, rendering.rgb, case, 0, [0, 1]),
            NEAREST: self._measure(nearest, truth, valid),
            ORACLE_PLANE: self._measure(plane, truth, valid),
        }
        if show is not None:
            show(_strip_name(case, 0), comparison_strip(truth, valid, rendering, plane))
        targets = [TargetScores(case.targets.names[0], scores)]
        return CaseScores(case.context.names, targets, *input_psnr(scene, case.context), scene.seconds)

    def _window(
        self, case: EvalCase, around: Sequence[Sequence[int]], pairs: dict[str, Scores], show: Show | None
    ) -> CaseScores:
        """Evaluate several views and the held-out frames between them.

        around: for each held-out frame, the context views around it. pairs: each frame's scores from two views.
        """
        scene = self.predict(case)
        targets = []
        for index, name in enumerate(case.targets.names):
            truth, valid = case.targets.image(index), case.targets.valid[index]
            rendering = render_target(scene.gaussians, case.targets, index)
            measured = self._measure_scene(scene, rendering.rgb, case, index, around[index])
            scores = {MODEL: measured, PAIRS: pairs[name][MODEL]}
            scores |= {method: pairs[name][method] for method in (NEAREST, ORACLE_PLANE)}
            targets.append(TargetScores(name, scores))
            if show is not None:
                show(_strip_name(case, index), comparison_strip(truth, valid, rendering, None))
        return CaseScores(case.context.names, targets, *input_psnr(scene, case.context), scene.seconds)

    def _measure_scene(
        self, scene: Scene, image: np.ndarray, case: EvalCase, index: int, around: Sequence[int]
    ) -> dict[str, float]:
        """The metrics of a held-out frame's render, and its PSNR in the mean exposure of the context views around."""
        truth, valid = case.targets.image(index), case.targets.valid[index]
        interpolated = scene.in_exposure_of(image, around)
        return self._measure(image, truth, valid) | {INTERPOLATED: psnr(interpolated, truth, valid)}

    def _measure(self, image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float]:
        scores = {
            "psnr": psnr(image, truth, valid),
            "psnr_fitted": psnr(fit_exposure(image, truth, valid), truth, valid),
            "ssim": ssim(image, truth, valid),
        }
        return scores | {name: metric(image, truth, valid) for name, metric in self.perceptual.items()}


def mean_of_captures(results: Sequence[CaptureScores], count: int) -> Scores:
    """The mean over the captures that have `count` views, each with the same weight."""
    means = [result.mean(count) for result in results if count in result.cases]
    return {
        method: {name: float(np.mean([mean[method][name] for mean in means])) for name in metrics}
        for method, metrics in means[0].items()
    }


def input_psnr(scene: Scene, context: PosedImages) -> tuple[float, float]:
    """The mean PSNR of the context frames rendered from all Gaussians: in their exposure, and each in its own."""
    common, own = [], []
    for view in range(len(context)):
        image = render_target(scene.gaussians, context, view).rgb
        common.append(psnr(image, context.image(view), context.valid[view]))
        own.append(psnr(scene.in_exposure_of(image, [view]), context.image(view), context.valid[view]))
    return float(np.mean(common)), float(np.mean(own))


def _view_batch(context: PosedImages) -> ViewBatch:
    """Context views as a reconstruction has them; they are refined on at the size that the network gets."""
    cameras = context.cameras()
    copies = [
        UndistortedImage(to_uint8(context.image(view)), camera, context.valid[view])
        for view, camera in enumerate(cameras)
    ]
    return ViewBatch(context.names, context.images, context.extrinsics, context.intrinsics, cameras, copies=copies)


def _strip_name(case: EvalCase, target: int) -> str:
    return f"{case.name}-{Path(case.targets.names[target]).stem}"
