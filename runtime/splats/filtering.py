"""Optional filters: opacity threshold, border crop, depth discontinuities, consistency, duplicates, holes.

A prediction has one Gaussian for each pixel of each view, so the filters can use the depth maps and the other views.
They run in the order of the fields of `FilterOptions`, each on what the ones before it kept.
"""

from dataclasses import dataclass, fields

import numpy as np

from ..errors import InputError
from ..geometry.consistency import depth_jumps, multi_view_consistency
from .fusion import MIN_VOTING_VIEWS, find_contradicted, find_redundant
from .gaussians import Gaussians
from .holes import close_holes
from .merging import find_duplicates, merge_gaussians
from .surfaces import Surfaces

# The filter that is part of fusion, and no option.
REDUNDANT = "remove_redundant"


@dataclass(frozen=True)
class FilterOptions:
    """Which Gaussians to remove or change; none by default.

    min_opacity: those with a lower opacity, 0 to 1.
    crop_border: those of so many pixels along the edges of every image, where networks have the least context.
    max_depth_jump: those of pixels whose depth differs from a neighbour's by more than this fraction of it: at object
        boundaries, where depth maps put points between foreground and background. 0 for no limit.
    min_consistency: those of pixels whose depth is confirmed by a smaller fraction of the other views, 0 to 1; see
        `geometry.consistency.multi_view_consistency`.
    remove_contradicted: those that other views see through, with three views or more, and with four those that most
        disagree with: its `same_color`, 0 for none; see `fusion.find_contradicted`.
    merge_duplicates: merge Gaussians that different views predict at the same point of a surface into one.
    remove_redundant: those of surfaces that so many other views show, 0 for none; see `fusion.find_redundant`.
    close_holes: fit shapes to the surface, and continue background behind depth edges; see `holes.close_holes`.

    Raises InputError if a value is out of range.
    """

    min_opacity: float = 0.0
    crop_border: int = 0
    max_depth_jump: float = 0.0
    min_consistency: float = 0.0
    remove_contradicted: float = 0.0
    merge_duplicates: bool = False
    remove_redundant: int = 0
    close_holes: bool = False

    def __post_init__(self) -> None:
        for name in ("min_opacity", "min_consistency"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{_option(name)} {getattr(self, name):g}: expected a number from 0 to 1")
        if self.crop_border < 0:
            raise InputError(f"--crop-border {self.crop_border}: expected a number of pixels, 0 or more")
        if not 0 <= self.max_depth_jump < np.inf:
            raise InputError(
                f"--max-depth-jump {self.max_depth_jump:g}: expected a fraction of the depth, such as 0.05"
            )

    @property
    def enabled(self) -> list[str]:
        """Names of the filters that are on, in the order in which they run."""
        return [field.name for field in fields(self) if getattr(self, field.name)]


def filter_gaussians(
    gaussians: Gaussians,
    depth: np.ndarray,
    extrinsics: np.ndarray,
    intrinsics: np.ndarray,
    options: FilterOptions,
    voters: list[np.ndarray] | None = None,
    images: np.ndarray | None = None,
) -> tuple[Gaussians, dict[str, int]]:
    """The Gaussians that the filters keep, and how many each filter removed, by its name.

    With `close_holes`, those that it adds stand after those that are kept.

    gaussians: one for each pixel, ordered by view, row, column. depth: z-depth, [views, height, width]. extrinsics:
    camera-to-world, OpenCV axes, [views, 4, 4]. intrinsics: normalised by width and height, [views, 3, 3]. voters: the
    views that may contradict each view, as arrays of indices; by default all others. `min_consistency` asks all.
    images: RGB in [0, 1], [views, 3, height, width], for votes by colour.
    Raises InputError if a border is wider than the images, or no Gaussian is left.
    """
    means = gaussians.means.reshape(*depth.shape, 3)
    surfaces = Surfaces(means, depth, extrinsics, intrinsics, images, voters)
    kept, removed = np.ones(depth.shape, bool), {}
    for name in options.enabled:
        before = int(kept.sum())
        match name:
            case "min_opacity":
                kept &= gaussians.opacities.reshape(depth.shape) >= options.min_opacity
            case "crop_border":
                kept &= _inner(depth.shape[1:], options.crop_border)
            case "max_depth_jump":
                kept &= depth_jumps(depth) <= options.max_depth_jump
            case "min_consistency":
                kept &= multi_view_consistency(means, depth, extrinsics, intrinsics) >= options.min_consistency
            case "remove_contradicted":
                if len(depth) >= MIN_VOTING_VIEWS:
                    kept &= ~find_contradicted(surfaces, options.remove_contradicted)
            case "merge_duplicates":
                representative = find_duplicates(means, depth, kept, extrinsics, intrinsics)
                gaussians = merge_gaussians(gaussians, representative)
                kept &= representative == np.arange(kept.size).reshape(kept.shape)
            case "remove_redundant":
                kept &= ~find_redundant(surfaces, kept, options.remove_redundant)
            case "close_holes":
                continue  # it adds some: after all others
        removed[name] = before - int(kept.sum())
    if not kept.any():
        named = [_option(name) for name in removed if name != REDUNDANT] or ["fusion"]
        raise InputError(f"{', '.join(named)}: no Gaussian is left of {kept.size}; filter less")
    if options.close_holes:
        return close_holes(gaussians, surfaces, kept), removed
    return gaussians.select(kept.ravel()), removed


def describe_removed(removed: dict[str, int], left: int) -> str:
    """The counts of `filter_gaussians` in one line."""
    words = {
        "min_opacity": "below the opacity threshold",
        "crop_border": "at image borders",
        "max_depth_jump": "at depth discontinuities",
        "min_consistency": "not confirmed by other views",
        "remove_contradicted": "that other views see through",
        "merge_duplicates": "merged into another view's",
        "remove_redundant": "that other views show as well",
        "free_space": "right before the cameras",
    }
    counts = ", ".join(f"{count:,} {words[name]}" for name, count in removed.items())
    return f"filtered: {counts}; {left:,} Gaussians left"


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _inner(shape: tuple[int, ...], border: int) -> np.ndarray:
    """A mask [height, width] of the pixels inside a border."""
    if 2 * border >= min(shape):
        raise InputError(f"--crop-border {border}: nothing is left of {shape[0]}x{shape[1]} pixels; use a smaller one")
    inner = np.zeros(shape, bool)
    inner[border : shape[0] - border, border : shape[1] - border] = True
    return inner
