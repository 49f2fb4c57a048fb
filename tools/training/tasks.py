"""What a training run trains: the whole network, phase by phase, or the Gaussian head alone on cached features."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, TypeVar

from torch import Tensor

from ...model.idesplat.network import IDESplat
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
from .losses import Perceptual
from .scenes import SampleSpec, Views, training_spec
from .schedule import Objective, Phase, training_phases
from .step import scene_loss

Source = Callable[[SampleSpec], Views]
Sample = TypeVar("Sample")
Losses = tuple[Tensor, dict[str, float]]


class TrainingTask(ABC, Generic[Sample]):
    """Which scenes a step has, and the loss of each. Subclasses say which parameters are trained."""

    # The beginnings of the names of the trained parameters; the empty one is that of all.
    trained: tuple[str, ...] = ("",)
    phases: tuple[Phase, ...]

    @abstractmethod
    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """The scene at place `slot` of a step's batch."""

    @abstractmethod
    def load(self, spec: SampleSpec) -> Sample:
        """The scene of an order; it runs beside `loss`, in another thread."""

    @abstractmethod
    def loss(self, model: IDESplat, sample: Sample, step: int, phase: Phase) -> Losses:
        """The loss of a scene, and what is logged of it."""

    def prepare(self, model: IDESplat) -> None:
        """Change the weights that a new run starts from."""


class FullNetworkTask(TrainingTask[Views]):
    """All of the network, in phases."""

    def __init__(
        self,
        phases: tuple[Phase, ...],
        objective: Objective,
        seed: int,
        size: int,
        source: Source,
        real_ratio: float,
        perceptual: Perceptual | None,
    ) -> None:
        """size: images' side in the last phase, pixels. real_ratio: share of the scenes that are captures."""
        self.phases, self.objective, self.perceptual = phases, objective, perceptual
        self.seed, self.size, self.source, self.real_ratio = seed, size, source, real_ratio

    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """As `training_spec`; captures only where novel views are rendered, since they have no true depth."""
        side = self.size // phase.shrink
        ratio = self.real_ratio if phase.gaussians else 0.0
        return training_spec(self.seed, step, slot, phase.gaussians, side, side, phase.units > 1, ratio)

    def load(self, spec: SampleSpec) -> Views:
        """The scene's views."""
        return self.source(spec)

    def loss(self, model: IDESplat, sample: Views, step: int, phase: Phase) -> Losses:
        """As `scene_loss`."""
        return scene_loss(model, sample, phase, self.objective, self.perceptual, step)


class HeadTask(TrainingTask[HeadSample]):
    """The Gaussian head alone, on a set of scenes that is repeated."""

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
        perceptual: Perceptual | None,
    ) -> None:
        """size: images' side, pixels. scenes: how many different ones. real_ratio: share of captures among them."""
        self.cache, self.perceptual = cache, perceptual
        self.seed, self.size, self.batch, self.scenes, self.real_ratio = seed, size, batch, scenes, real_ratio

    def spec(self, step: int, slot: int, phase: Phase) -> SampleSpec:
        """Every scene once an epoch."""
        index = scene_index(self.seed, step * self.batch + slot, self.scenes)
        return head_spec(self.seed, index, self.size, self.size, self.real_ratio)

    def load(self, spec: SampleSpec) -> HeadSample:
        """The scene's cached features."""
        return self.cache.load(spec)

    def loss(self, model: IDESplat, sample: HeadSample, step: int, phase: Phase) -> Losses:
        """As `head_loss`."""
        return head_loss(model, sample, step, self.perceptual)

    def prepare(self, model: IDESplat) -> None:
        """Reset saturated opacities."""
        reset_opacity(model, (self.load(self.spec(step, 0, self.phases[0])) for step in range(RESET_SCENES)))
