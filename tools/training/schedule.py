"""Curriculum and learning rate of a training run.

The curriculum goes from coarse to fine. Images have half their final size at first; DPBU 1 is trained alone, then
with DPBU 2, then all three with depth fusion. The size is then doubled, and at last the Gaussians are predicted and
novel views rendered. Earlier parts stay trainable in later phases.
"""

import math
from dataclasses import dataclass, replace

from .options import Objective

# Linear warm-up of the learning rate: this share of all steps, at most so many steps.
WARM_UP, MAX_WARM_UP_STEPS = 0.02, 200
# Short runs warm up longer, since Adam's second moments are poor in the first steps, which can saturate opacities.
SHORT_WARM_UP, SHORT_WARM_UP_STEPS = 0.1, 50
# The learning rate at the last step, relative to the highest.
FINAL_LR_FACTOR = 0.01


@dataclass(frozen=True)
class Phase:
    """A phase of the curriculum.

    end: the share of all steps at which it ends. dpbus: how many depth probability boosting units run, 1 to 3.
    gaussians: whether Gaussians are predicted and novel views rendered. downsample: the run's image size is divided by
    this. progress: how far one step advances the cosine schedule of the learning rate, relative to a step of the first
    phase; about what it costs.
    """

    end: float
    dpbus: int
    gaussians: bool
    downsample: int
    progress: float = 1.0


# DPBU 1 converges at half the size within some 2500 steps. The other parts need the full size, at which disparities are
# twice as large in pixels and splats have the scale in scene units that they have in use.
CURRICULUM = (
    Phase(0.57, dpbus=1, gaussians=False, downsample=2),
    Phase(0.64, dpbus=2, gaussians=False, downsample=2, progress=2.0),
    Phase(0.74, dpbus=3, gaussians=False, downsample=2, progress=3.0),
    Phase(0.87, dpbus=3, gaussians=False, downsample=1, progress=11.0),
    Phase(1.00, dpbus=3, gaussians=True, downsample=1, progress=15.0),
)


def training_phases(objective: Objective, curriculum: bool) -> tuple[Phase, ...]:
    """The phases of a run; the photometric objective has a single one, since it does not supervise depth.

    The depth objective has those that predict no Gaussians, each for a larger share of the steps.
    """
    rendered = objective is not Objective.DEPTH
    if not curriculum or objective is Objective.PHOTOMETRIC:
        return (Phase(1.0, dpbus=3, gaussians=rendered, downsample=1),)
    if rendered:
        return CURRICULUM
    depth_phases = [phase for phase in CURRICULUM if not phase.gaussians]
    return tuple(replace(phase, end=phase.end / depth_phases[-1].end) for phase in depth_phases)


def phase_at(phases: tuple[Phase, ...], step: int, steps: int) -> Phase:
    """The phase of a step, counted from 0, of `steps` in all."""
    return next((phase for phase in phases if step < phase.end * steps), phases[-1])


def lr_factor(phases: tuple[Phase, ...], step: int, steps: int) -> float:
    """Learning rate at a step, counted from 0, relative to the highest: linear warm-up, then cosine decay.

    factor = f + (1 - f) (1 + cos(pi p)) / 2 with f = FINAL_LR_FACTOR and p the share of the run's progress that is
    done, where each phase's steps count `Phase.progress` times, so that the last phases get a high rate, too.
    """
    short = min(SHORT_WARM_UP_STEPS, round(SHORT_WARM_UP * steps))
    warm_up = max(1, short, min(MAX_WARM_UP_STEPS, round(WARM_UP * steps)))
    if step < warm_up:
        return (step + 1) / warm_up
    start = _progress(phases, warm_up / steps)
    done = (_progress(phases, step / steps) - start) / (_progress(phases, 1.0) - start)
    return FINAL_LR_FACTOR + (1 - FINAL_LR_FACTOR) * 0.5 * (1 + math.cos(math.pi * done))


def _progress(phases: tuple[Phase, ...], share: float) -> float:
    """The progress of the first `share` of all steps."""
    starts = (0.0, *(phase.end for phase in phases))
    return sum(
        phase.progress * max(0.0, min(share, phase.end) - start) for phase, start in zip(phases, starts, strict=False)
    )
