"""What is trained when: coarse depth alone first, then finer, then Gaussians, at half the size until the last part."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

WARM_UP = 0.02  # of all steps
WARM_UP_STEPS = 200  # at most
# A short run warms up longer: Adam knows little of its gradients yet, and its first steps can saturate opacities.
SHORT_WARM_UP, SHORT_WARM_UP_STEPS = 0.1, 50
LAST_RATE = 0.01  # of the highest learning rate, at the last step


class Objective(StrEnum):
    """What the network is trained on."""

    DEPTH = "depth"
    PHOTOMETRIC = "photometric"
    BOTH = "both"


class Part(StrEnum):
    """Which part of the network is trained."""

    ALL = "all"
    HEAD = "head"


class PerceptualKind(StrEnum):
    """The perceptual distance beside the squared error of rendered views."""

    LPIPS = "lpips"
    LITE0 = "lite0"
    NONE = "none"


class Precision(StrEnum):
    """Number format of convolutions and attention in training."""

    FLOAT32 = "float32"
    BF16 = "bf16"


@dataclass(frozen=True)
class Phase:
    """A part of the run, which ends at the share `until` of all steps."""

    until: float
    # Boosting units that run, 1 to 3.
    units: int
    # Whether the Gaussians are predicted and novel views rendered.
    gaussians: bool
    # Images have the run's size over this.
    shrink: int
    # What a step costs, and teaches, beside one of the first phase.
    effort: float = 1.0


# The coarse unit learns what it can at half the size in some 2500 steps. The rest is learned at the full size, where a
# pixel's disparity is twice as large, and where splats have the size in scene units that they will be used with.
CURRICULUM = (
    Phase(0.57, units=1, gaussians=False, shrink=2),
    Phase(0.64, units=2, gaussians=False, shrink=2, effort=2.0),
    Phase(0.74, units=3, gaussians=False, shrink=2, effort=3.0),
    Phase(0.87, units=3, gaussians=False, shrink=1, effort=11.0),
    Phase(1.00, units=3, gaussians=True, shrink=1, effort=15.0),
)


def training_phases(objective: Objective, curriculum: bool) -> tuple[Phase, ...]:
    """The phases of a run; without true depth in the objective there is nothing to train the coarse part on alone."""
    rendered = objective is not Objective.DEPTH
    if not curriculum or objective is Objective.PHOTOMETRIC:
        return (Phase(1.0, units=3, gaussians=rendered, shrink=1),)
    return tuple(replace(phase, gaussians=phase.gaussians and rendered) for phase in CURRICULUM)


def phase_at(phases: tuple[Phase, ...], step: int, steps: int) -> Phase:
    """The phase that a step, counted from 0, belongs to."""
    return next((phase for phase in phases if step < phase.until * steps), phases[-1])


def lr_factor(phases: tuple[Phase, ...], step: int, steps: int) -> float:
    """The share of the highest learning rate at a step, counted from 0: a linear warm-up, then a cosine.

    The cosine goes by the effort spent, not by steps, so that the last and largest steps still teach.
    """
    short = min(SHORT_WARM_UP_STEPS, round(SHORT_WARM_UP * steps))
    warm_up = max(1, short, min(WARM_UP_STEPS, round(WARM_UP * steps)))
    if step < warm_up:
        return (step + 1) / warm_up
    start = _effort(phases, warm_up / steps)
    done = (_effort(phases, step / steps) - start) / (_effort(phases, 1.0) - start)
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))


def _effort(phases: tuple[Phase, ...], share: float) -> float:
    """The effort of the first `share` of all steps."""
    starts = (0.0, *(phase.until for phase in phases))
    return sum(
        phase.effort * max(0.0, min(share, phase.until) - start) for phase, start in zip(phases, starts, strict=False)
    )
