"""Training tasks: the full network, phase by phase, or the Gaussian head alone on cached features."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from torch import Tensor

from ...model.idesplat.network import IDESplat
from ..perceptual import Perceptual
from .data.samples import SampleSpec, TrainingViews, stack_scenes
from .data.synthetic import training_spec
from .head import (
    HEAD_PREFIXES,
    RESET_SCENES,
    FeatureCache,
    HeadSample,
    head_loss,
    head_spec,
    reset_opacity,
    scene_index,
)
from .options import NO_TERMS, Objective, OptionalTerms, TargetViews
from .schedule import Phase, training_phases
from .step import scene_loss

Source = Callable[[SampleSpec], TrainingViews]
Sample = TypeVar("Sample")
Losses = tuple[Tensor, dict[str, float]]

# Pairs of views that a scene of two views matches: each view with the other.
TWO_VIEW_PAIRS = 2


class TrainingTask(ABC, Generic[Sample]):
    """The samples of a step, the loss of each, and which parameters are trained."""

    # Prefixes of the names of the trained parameters; the empty prefix is that of all.
    trained: tuple[str, ...] = ("",)
    phases: tuple[Phase, ...]

    @abstractmethod
    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """The sample at place `slot` of a step's batch."""

    @abstractmethod
    def load(self, spec: SampleSpec) -> Sample:
        """Load a sample; called in a background thread."""

    def at_once(self, model: IDESplat, sample: Sample, phase: Phase) -> int:
        """How many samples of a step, all with as many views as this one, `loss` takes at once."""
        return 1

    @abstractmethod
    def loss(self, model: IDESplat, samples: Sequence[Sample], step: int, phase: Phase) -> Losses:
        """The mean loss of the samples, as many as `at_once` allows, and what is logged."""

    def prepare(self, model: IDESplat) -> None:
        """Adapt the weights that a new run starts from."""


class FullNetworkTask(TrainingTask[TrainingViews]):
    """All parts of the network, in phases."""

    def __init__(
        self,
        phases: tuple[Phase, ...],
        objective: Objective,
        seed: int,
        size: int,
        source: Source,
        real_ratio: float,
        targets: TargetViews,
        perceptual: Perceptual | None,
        terms: OptionalTerms = NO_TERMS,
        together: int = 1,
    ) -> None:
        """size: side of the images in the last phase, in pixels. real_ratio: probability of a capture.

        together: how many scenes of two views the network takes at once.
        """
        self.targets, self.together = targets, together
        self.phases, self.objective, self.perceptual, self.terms = phases, objective, perceptual, terms
        self.seed, self.size, self.source, self.real_ratio = seed, size, source, real_ratio

    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """As `training_spec`; captures only in phases that render, since they have no true depth."""
        side = self.size // phase.downsample
        ratio = self.real_ratio if phase.gaussians else 0.0
        more_views = phase.dpbus > 1
        return training_spec(self.seed, step, slot, phase.gaussians, side, side, more_views, ratio, self.targets.zoom)

    def load(self, spec: SampleSpec) -> TrainingViews:
        """The views of a sample."""
        return self.source(spec)

    def at_once(self, model: IDESplat, sample: TrainingViews, phase: Phase) -> int:
        """Fewer scenes of more views: memory and time grow with the pairs of views that are matched."""
        if self.terms.pm_loss or self.terms.aperture:
            return 1  # these terms are of one scene
        views = len(sample.images)
        pairs = views * min(views - 1, model.config.neighbours)
        return max(1, self.together * TWO_VIEW_PAIRS // pairs)

    def loss(self, model: IDESplat, samples: Sequence[TrainingViews], step: int, phase: Phase) -> Losses:
        """As `scene_loss`, on the device of the network."""
        views = (stack_scenes(samples) if len(samples) > 1 else samples[0]).to(next(model.parameters()).device)
        return scene_loss(model, views, phase, self.objective, self.perceptual, step, self.terms, self.targets.inputs)


class HeadTask(TrainingTask[HeadSample]):
    """The Gaussian head alone, on a fixed set of scenes that is repeated every epoch."""

    trained = HEAD_PREFIXES
    phases = training_phases(Objective.PHOTOMETRIC, curriculum=False)

    def __init__(
        self,
        cache: FeatureCache,
        seed: int,
        size: int,
        batch: int,
        scenes: int,
        real_ratio: float,
        targets: TargetViews,
        perceptual: Perceptual | None,
    ) -> None:
        """size: side of the images, in pixels. scenes: their number. real_ratio: probability of a capture."""
        self.cache, self.targets, self.perceptual = cache, targets, perceptual
        self.seed, self.size, self.batch, self.scenes, self.real_ratio = seed, size, batch, scenes, real_ratio

    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """Every scene once per epoch, in random order."""
        index = scene_index(self.seed, step * self.batch + slot, self.scenes)
        return head_spec(self.seed, index, self.size, self.size, self.real_ratio, self.targets.zoom)

    def load(self, spec: SampleSpec) -> HeadSample:
        """The cached features of a sample."""
        return self.cache.load(spec)

    def loss(self, model: IDESplat, samples: Sequence[HeadSample], step: int, phase: Phase) -> Losses:
        """As `head_loss`."""
        return head_loss(model, samples[0], step, self.perceptual, self.targets.inputs)

    def prepare(self, model: IDESplat) -> None:
        """Reset saturated opacities."""
        reset_opacity(model, (self.load(self.spec(step, 0, self.phases[0])) for step in range(RESET_SCENES)))
