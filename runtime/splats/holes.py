"""Closing of holes: shapes that follow the surface, background behind depth edges, and a backdrop behind all."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..system.threads import thread_count
from .backdrop import make_backdrop
from .background import continue_background
from .gaussians import Gaussians
from .surface_shape import fit_to_surface
from .surfaces import Surfaces


def close_holes(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray) -> Gaussians:
    """The Gaussians of `close_surfaces`, then each view's `backdrop.make_backdrop`; arguments as there."""
    views, pixels = len(kept), kept[0].size
    backdrops = [make_backdrop(gaussians.select(_of_view(view, pixels)), surfaces, kept, view) for view in range(views)]
    return Gaussians.concatenate([close_surfaces(gaussians, surfaces, kept), *backdrops])


def close_surfaces(gaussians: Gaussians, surfaces: Surfaces, kept: np.ndarray) -> Gaussians:
    """The kept Gaussians in the shapes of `surface_shape.fit_to_surface`, then `background.continue_background`'s.

    gaussians: one for each pixel, ordered by view, row, column. kept: those that filters kept, bool [views, height,
    width].
    """
    views, pixels = len(kept), kept[0].size
    spacings = surfaces.spacings  # computed once, and not by each thread

    def close(view: int) -> tuple[Gaussians, Gaussians]:
        own = gaussians.select(_of_view(view, pixels))
        fitted = fit_to_surface(own, surfaces, spacings, kept, view)
        return fitted.select(kept[view].ravel()), continue_background(fitted, surfaces, kept, view)

    with ThreadPoolExecutor(min(views, thread_count())) as pool:
        fitted, continued = zip(*pool.map(close, range(views)), strict=True)
    return Gaussians.concatenate([*fitted, *continued])


def _of_view(view: int, pixels: int) -> np.ndarray:
    return np.arange(pixels * view, pixels * (view + 1))
