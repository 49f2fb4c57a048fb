"""Random layouts of synthetic scenes: what stands where, and where cameras may stand."""

from collections.abc import Callable

import numpy as np

from .builder import Layout
from .indoor import bars, cards, clutter, covered_table, daylit_room, furnished_room, still_life, table_top
from .outdoor import (
    around_object,
    facade,
    foliage,
    from_above,
    hills,
    ruins,
    sculpture,
    street,
    street_under_far_sky,
)
from .textures import Textures

# Kinds of scenes; one that is repeated is more probable. The second tuple is used in training alone.
LAYOUTS: tuple[Callable[[np.random.Generator, Textures], Layout], ...] = (
    *(furnished_room, furnished_room, furnished_room),
    *(clutter, clutter, street, table_top, cards),
)
TRAINING_LAYOUTS = (
    *(facade, around_object, around_object, from_above, foliage, hills, covered_table, bars),
    *(street_under_far_sky, ruins, sculpture, daylit_room, daylit_room, still_life),
)


def generate_layout(rng: np.random.Generator, textures: Textures, training: bool = False) -> Layout:
    """A scene of a random kind. training: whether `TRAINING_LAYOUTS` are among the kinds."""
    layouts = LAYOUTS + TRAINING_LAYOUTS if training else LAYOUTS
    return layouts[rng.integers(len(layouts))](rng, textures)
