"""Quality presets: how many views and pixels a reconstruction uses, and how long it is refined."""

import re
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from pathlib import Path

from ..errors import InputError
from ..inference.bundled_model import bundled_model

STEPS_OR_SECONDS = re.compile(r"([0-9]{1,6})(s?)")
MAX_STEPS = 100_000
COPY_SIDE = 384
SECONDS_PER_FURTHER_VIEW = 8


class Quality(StrEnum):
    """The names of the presets."""

    FAST = "fast"
    STANDARD = "standard"
    HIGH = "high"


@dataclass(frozen=True)
class RefinementLimit:
    """When a refinement ends: after so many steps, or seconds."""

    steps: int
    seconds: float = inf


@dataclass(frozen=True)
class Preset:
    """A trade of time for quality.

    views: how many images are used where neither --views nor --select says it. pixels: least area of the images that
    the network gets; that of its training if larger. fuse: whether depths are corrected by the other views,
    Gaussians that these see through and surplus copies of a surface are removed, holes closed, and colours fitted to
    the images where no refinement follows.
    steps_per_added_view, seconds: of the refinement, whichever ends first; no steps for none. Steps count for each
    image beyond the first: two images are soon overfitted, more are not. The seconds are those of `views` images; each
    further one adds SECONDS_PER_FURTHER_VIEW. copy_side: longer side of the images that it fits, in pixels.
    """

    views: int
    pixels: int
    fuse: bool
    steps_per_added_view: int
    seconds: float
    copy_side: int

    def steps(self, views: int) -> int:
        """Steps of the refinement on so many images, where its time does not end it."""
        return self.steps_per_added_view * max(views - 1, 1)

    def limit(self, views: int) -> RefinementLimit:
        """When the refinement on so many images ends."""
        return RefinementLimit(self.steps(views), self.seconds + SECONDS_PER_FURTHER_VIEW * max(0, views - self.views))


PRESETS = {
    Quality.FAST: Preset(views=2, pixels=0, fuse=False, steps_per_added_view=0, seconds=inf, copy_side=COPY_SIDE),
    Quality.STANDARD: Preset(views=8, pixels=0, fuse=True, steps_per_added_view=40, seconds=36, copy_side=COPY_SIDE),
    Quality.HIGH: Preset(views=24, pixels=1 << 17, fuse=True, steps_per_added_view=60, seconds=160, copy_side=640),
}


def default_quality(model: Path) -> Quality:
    """The preset where none is asked for: standard for the bundled model, and for others fast: what they predict.

    model: its path. Raises InputError if the bundled model is missing or damaged.
    """
    return Quality.STANDARD if model == bundled_model() else Quality.FAST


def parse_refine(text: str) -> RefinementLimit:
    """The option --refine: a number of steps, 0 for none, or a time such as `30s`; raises InputError."""
    found = STEPS_OR_SECONDS.fullmatch(text.strip())
    if found is None or (found[2] and not int(found[1])) or (not found[2] and int(found[1]) > MAX_STEPS):
        raise InputError(
            f"--refine {text[:40]}: expected a number of steps up to {MAX_STEPS}, 0 for none, or a time such as 30s"
        )
    return RefinementLimit(MAX_STEPS, float(found[1])) if found[2] else RefinementLimit(int(found[1]))
