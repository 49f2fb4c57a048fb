"""The options of a refinement, and those that suit a number of views."""

from dataclasses import dataclass
from typing import Any

# How the Gaussians of a feed-forward prediction start, measured on held-out views of real captures
# (docs/reconstruction.md). The network's are small and opaque, so that a layer that is nearer by a hair hides the
# others; larger ones that let light through have gradients and average.
PREDICTION_OPACITY, PREDICTION_SCALE = 0.2, 2.0

# What their regularisation is, measured there, too: of the Gaussians that show one surface, those that the images need
# less become transparent, and fewer, larger ones show it.
PREDICTION_OPACITY_DECAY, PREDICTION_SCALE_GROWTH = 0.25, 0.005
MOST_GROWTH = 1.0  # of the log scales in all steps, before it decays: many views have many steps

# Fainter ones are removed: a seventh of them, without which held-out views are the same within 0.01 dB.
PREDICTION_MIN_OPACITY = 0.05

# Learning rate of poses where they are refined.
POSE_LR = 3e-4


@dataclass(frozen=True)
class RefinementOptions:
    """What a refinement does.

    steps: of the optimiser, one view each. seconds: after which it ends, whatever the steps. seed: of the order of the
    views. max_gaussians: how many to keep at most, those that contribute most to the views; 0 for all.
    min_opacity: of what is kept.
    max_opacity, scale_factor: limit the opacities and enlarge the scales at the start: saturated opacities have almost
    no gradient, and lower ones leave gaps between splats.
    opacity_decay, scale_growth: subtracted from the opacity logits, times the gradient of the opacity, and added to the
    log scales, of the Gaussians that a step's view sees; both decay with the learning rates.
    ssim_weight: of 1 - SSIM against L1. lr_*: learning rates of Adam; of the means, relative to the median depth; of SH
    of degree 1, to (1 - 2 / views) over the spread of the views' directions; lr_sh is of degrees 2 and 3.
    lr_poses: of the views' poses, in radians, and relative to the median depth; 0 leaves them as given.
    final_lr: what is left of the learning rates at the end, as they decay exponentially.
    """

    steps: int = 120
    seconds: float = float("inf")
    seed: int = 0
    max_gaussians: int = 0
    min_opacity: float = 0.0
    max_opacity: float = 0.99
    scale_factor: float = 1.0
    opacity_decay: float = 0.0
    scale_growth: float = 0.0
    ssim_weight: float = 0.2
    lr_means: float = 2e-3
    lr_scales: float = 6e-2
    lr_quats: float = 1.2e-2
    lr_opacities: float = 0.3
    lr_dc: float = 1e-2
    lr_sh_1: float = 4.5e-3
    lr_sh: float = 6e-3
    lr_exposure: float = 1e-3
    lr_poses: float = 0.0
    final_lr: float = 0.1


def prediction_options(steps: int, **options: Any) -> RefinementOptions:
    """The options for a prediction; without steps, it is left as it is but for `max_gaussians`."""
    if not steps:
        return RefinementOptions(steps=0, max_opacity=1, **options)
    return RefinementOptions(
        steps=steps,
        min_opacity=PREDICTION_MIN_OPACITY,
        max_opacity=PREDICTION_OPACITY,
        scale_factor=PREDICTION_SCALE,
        opacity_decay=PREDICTION_OPACITY_DECAY,
        scale_growth=min(PREDICTION_SCALE_GROWTH, MOST_GROWTH / steps),
        **options,
    )
