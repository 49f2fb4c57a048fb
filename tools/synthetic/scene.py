"""The arrays of a synthetic scene, as the ray caster reads them."""

from typing import NamedTuple

import numpy as np

WAVES = 4  # of a height field or a free-form solid


class Scene(NamedTuple):
    """Solids, materials and lights, in metres; y points down. Solid 0 encloses all others and the cameras.

    A material's texture coordinates are `uv @ (a, b, 1)` for the two local coordinates (a, b) of a face, in periods of
    the texture; its colour is `colour @ (r, g, b, 1)` for a texel (r, g, b).
    """

    shapes: np.ndarray  # [solids] int64: BOX, ELLIPSOID, CYLINDER, HEIGHT_FIELD or FREE_FORM
    centres: np.ndarray  # [solids, 3]
    axes: np.ndarray  # [solids, 3, 3], rows: the local axes in the world
    halves: np.ndarray  # [solids, 3], half extents along the local axes
    cut_shapes: np.ndarray  # [solids] int64, of what is cut out: BOX, ELLIPSOID, CYLINDER or UNCUT
    cuts: np.ndarray  # [solids, 3, 4], from the solid's unit frame to that of what is cut out: `cuts @ (x, y, z, 1)`
    waves: np.ndarray  # [solids, WAVES, 5], of height fields and free-form solids (`_wave_sum`, `_form` in raycast.py)
    forms: np.ndarray  # [solids, 2], of free-form solids: squareness, and upper bound of the slope of `_form`
    materials: np.ndarray  # [solids, 6] int64, of the faces -x, +x, -y, +y, -z, +z
    textures: np.ndarray  # [materials] int64, index of a texture
    uv: np.ndarray  # [materials, 2, 3]
    colours: np.ndarray  # [materials, 3, 4]
    frequencies: np.ndarray  # [materials], periods of the texture per metre
    speculars: np.ndarray  # [materials], strength of the specular highlight
    emissions: np.ndarray  # [materials], emitted light
    light_positions: np.ndarray  # [lights, 3]
    light_colours: np.ndarray  # [lights, 3]
    light_reaches: np.ndarray  # [lights], distance at which intensity is halved
    light_lengths: np.ndarray  # [lights], half length of the linear lamp, for soft shadows; negative: no shadows
    ambient: np.ndarray  # [3]
