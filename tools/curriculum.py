"""What is trained when: coarse depth alone first, then finer, then Gaussians, at half the size until the last part."""

import math
from dataclasses import dataclass
from enum import StrEnum

WARM_UP = 0.02  # of all steps
WARM_UP_STEPS = 200  # at most
LAST_RATE = 0.01  # of the highest learning rate, at the last step


class Objective(StrEnum):
    """What the network is trained on."""

    DEPTH = "depth"
    PHOTOMETRIC = "photometric"
    BOTH = "both"


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


GRADUAL = (
    Phase(0.620, units=1, gaussians=False, shrink=2),
    Phase(0.770, units=2, gaussians=False, shrink=2),
    Phase(0.870, units=3, gaussians=False, shrink=2),
    Phase(0.985, units=3, gaussians=True, shrink=2),
    Phase(1.000, units=3, gaussians=True, shrink=1),
)


def curriculum(objective: Objective, gradual: bool) -> tuple[Phase, ...]:
    """The phases of a run; without true depth in the objective there is nothing to train the coarse part on alone."""
    rendered = objective is not Objective.DEPTH
    if not gradual or objective is Objective.PHOTOMETRIC:
        return (Phase(1.0, units=3, gaussians=rendered, shrink=1),)
    return tuple(Phase(p.until, p.units, p.gaussians and rendered, p.shrink) for p in GRADUAL)


def phase_at(phases: tuple[Phase, ...], step: int, steps: int) -> Phase:
    """The phase that a step, counted from 0, belongs to."""
    return next((phase for phase in phases if step < phase.until * steps), phases[-1])


def rate_at(step: int, steps: int) -> float:
    """The share of the highest learning rate at a step, counted from 0: a linear warm-up, then a cosine."""
    warm_up = min(WARM_UP_STEPS, max(1, round(WARM_UP * steps)))
    if step < warm_up:
        return (step + 1) / warm_up
    done = (step - warm_up) / max(1, steps - warm_up)
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))
