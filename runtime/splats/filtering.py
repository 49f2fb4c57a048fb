"""Leaving out what spoils a scene: faint, marginal, torn, doubted and doubled Gaussians. Off unless asked for.

A prediction has one Gaussian for each pixel of each view, so that what is wrong with one can be read off its picture,
its depth map and the other views. Each step counts what it takes of what the steps before it left.
"""

from dataclasses import dataclass, fields

import numpy as np

from ..errors import InputError
from ..geometry.consistency import depth_jumps, multi_view_consistency
from .gaussians import Gaussians
from .merging import duplicates, merged


@dataclass(frozen=True)
class FilterOptions:
    """What to leave out; nothing by default.

    min_opacity: Gaussians less opaque than this, 0 to 1.
    crop_border: this many pixels along the edges of every image, where networks see the least.
    max_depth_jump: pixels whose depth differs from a neighbour's by more than this share of it: at the edges of
        objects, where depth maps put points between foreground and background. 0 for none.
    min_consistency: pixels of which a smaller share of the other views than this, 0 to 1, confirms the depth; see
        `consistency.confidence`.
    merge_duplicates: make one Gaussian of those that different views put at the same place of the same surface.
    """

    min_opacity: float = 0.0
    crop_border: int = 0
    max_depth_jump: float = 0.0
    min_consistency: float = 0.0
    merge_duplicates: bool = False

    def __post_init__(self) -> None:
        for name in ("min_opacity", "min_consistency"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{_option(name)} {getattr(self, name):g}: expected a number from 0 to 1")
        if self.crop_border < 0:
            raise InputError(f"--crop-border {self.crop_border}: expected a number of pixels, 0 or more")
        if not 0 <= self.max_depth_jump < np.inf:
            raise InputError(f"--max-depth-jump {self.max_depth_jump:g}: expected a share of the depth, such as 0.05")

    @property
    def enabled(self) -> list[str]:
        """Names of the steps to take, in order."""
        return [field.name for field in fields(self) if getattr(self, field.name)]


def filter_gaussians(
    gaussians: Gaussians, depth: np.ndarray, extrinsics: np.ndarray, intrinsics: np.ndarray, cleaning: FilterOptions
) -> tuple[Gaussians, dict[str, int]]:
    """What is left of the Gaussians, and how many each step took, by the names of the steps asked for.

    gaussians: one for each pixel, ordered by view, row, column. depth: z-depth, [views, height, width]. extrinsics:
    camera-to-world, OpenCV axes, [views, 4, 4]. intrinsics: normalised by width and height, [views, 3, 3].
    Raises InputError if a step does not fit the pictures, or nothing is left.
    """
    means = gaussians.means.reshape(*depth.shape, 3)
    kept, taken = np.ones(depth.shape, bool), {}
    for step in cleaning.enabled:
        before = int(kept.sum())
        match step:
            case "min_opacity":
                kept &= gaussians.opacities.reshape(depth.shape) >= cleaning.min_opacity
            case "crop_border":
                kept &= _inner(depth.shape[1:], cleaning.crop_border)
            case "max_depth_jump":
                kept &= depth_jumps(depth) <= cleaning.max_depth_jump
            case "min_consistency":
                kept &= multi_view_consistency(means, depth, extrinsics, intrinsics) >= cleaning.min_consistency
            case "merge_duplicates":
                same_as = duplicates(means, depth, kept, extrinsics, intrinsics)
                gaussians = merged(gaussians, same_as)
                kept &= same_as == np.arange(kept.size).reshape(kept.shape)
        taken[step] = before - int(kept.sum())
    if not kept.any():
        raise InputError(f"{', '.join(map(_option, taken))}: no Gaussian is left of {kept.size}; ask for less cleaning")
    return gaussians.select(kept.ravel()), taken


def describe_removed(taken: dict[str, int], left: int) -> str:
    """The counts of `filter_gaussians` in a line."""
    words = {
        "min_opacity": "too faint",
        "crop_border": "at borders",
        "max_depth_jump": "at depth edges",
        "min_consistency": "not confirmed by other views",
        "merge_duplicates": "merged into another view's",
    }
    return f"cleaned: {', '.join(f'{taken[step]:,} {words[step]}' for step in taken)}; {left:,} Gaussians left"


def _option(step: str) -> str:
    return "--" + step.replace("_", "-")


def _inner(shape: tuple[int, ...], border: int) -> np.ndarray:
    """A mask [height, width] of the pixels that are not at the border."""
    if 2 * border >= min(shape):
        raise InputError(f"--crop-border {border}: nothing is left of {shape[0]}x{shape[1]} pixels; use a smaller one")
    inner = np.zeros(shape, bool)
    inner[border : shape[0] - border, border : shape[1] - border] = True
    return inner
