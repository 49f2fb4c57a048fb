"""Closing of holes: shapes that follow the surface, background behind depth edges, and a backdrop behind all."""

import numpy as np

from ..system.threads import map_in_threads
from .backdrop import make_backdrop
from .background import continue_background
from .gaussians import Gaussians
from .surface_shape import ask_neighbors, fit_to_surface, mix_views
from .surfaces import Surfaces


def close_holes(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray) -> Gaussians:
    """The kept Gaussians, ordered by view, then what `close_view` adds.

    gaussians: one for each pixel, ordered by view, row, column. kept: those that filters kept, bool [views, height,
    width].
    """
    _ = surfaces.spacings  # computed once, and not by each thread
    parts = map_in_threads(lambda view: close_view(gaussians, surfaces, kept, view), len(kept))
    return Gaussians.concatenate([part for each in zip(*parts, strict=True) for part in each])


def close_view(
    gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray, view: int
) -> tuple[Gaussians, Gaussians, Gaussians]:
    """Of one view, the kept Gaussians in shapes that close the surface, the continued background and the backdrop.

    The background that is continued is hidden in all views, so that its Gaussians are not shared.
    """
    pixels = kept[view].size
    own = gaussians.select(np.arange(pixels * view, pixels * (view + 1)))
    votes = ask_neighbors(surfaces, kept, view)
    fitted = fit_to_surface(own, surfaces, votes, kept, view)
    return (
        mix_views(fitted, votes, len(kept)).select(kept[view].ravel()),
        continue_background(fitted, surfaces, kept, view),
        make_backdrop(own, surfaces, kept, view),
    )
