"""A builder of synthetic scenes: solids with materials, enclosing rooms or open ground, and lights.

y points down and the floor is at y = 0, so that heights are negative. Lengths are metres until a sample is scaled.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .raycast import BOX, ELLIPSOID, FREE_FORM, HEIGHT_FIELD, LUMINOUS, UNCUT
from .scene import WAVES, Scene
from .textures import PHOTO_KIND, Textures

# Kinds of textures (`textures.PATTERNS`) for surfaces; a kind that is repeated is more probable.
WALL_KINDS = ("plain", "plain", "plain", "brick", "stripes", "gradient", "noise", "weave", "glyphs", "cells")
FLOOR_KINDS = ("wood", "wood", "checker", "cells", "speckle", "brick", "weave", "strokes", "noise", "plain")
GROUND_KINDS = ("cells", "strokes", "noise", "brick", "speckle")
FURNITURE_KINDS = ("wood", "wood", "plain", "noise", "weave", "stripes", "gradient", "speckle")
POSTER_KINDS = ("collage", "collage", "glyphs", "gradient", "noise", "weave")
ANY_KINDS = (
    *("noise", "plain", "brick", "checker", "wood", "stripes", "speckle"),
    *("glyphs", "gradient", "cells", "weave", "strokes", "collage"),
)

# Periods of a height field's waves along its sides of length 2, and how much lower each wave is than the one before.
WAVE_PERIODS, WAVE_DECAY = (0.3, 1.5), 0.6
# Periods of a free-form solid's waves along its sides of length 2.
FORM_PERIODS = (0.5, 1.6)

# Distance of the sun in metres, at least, and in radii of the enclosing solid: parallel light, from outside a far sky.
SUN_DISTANCE, SUN_RADII = 200.0, 4.0
SUN_WIDTH = 0.03  # half length of the sun relative to its distance; wide, for penumbrae of some pixels

# The radius of a far sky, relative to the distance from which a scene is seen. Neighbouring context views are mostly
# less than 0.4 of that distance apart, so that the sky moves by 0.4 / 80 radians at most: about a pixel of 256. Farther
# would look no different, but widen far / near, and the loss has a term in the logarithm of depth.
SKY_DISTANCE = (80.0, 200.0)
# Share of the outdoor scenes of training layouts whose sky is far; the others have a box of 18 to 45 m.
FAR_SKY_PROBABILITY = 0.7
# Below and above clouds, RGB: clear, overcast and evening skies.
SKIES = (
    ((0.36, 0.56, 0.88), (0.95, 0.97, 1.0)),
    ((0.55, 0.72, 0.95), (0.88, 0.93, 1.0)),
    ((0.62, 0.66, 0.72), (0.93, 0.94, 0.95)),
    ((0.48, 0.50, 0.68), (1.0, 0.78, 0.58)),
)
# Colours of meadows, fields, sand and asphalt, RGB.
LANDS = ((0.30, 0.38, 0.20), (0.52, 0.48, 0.30), (0.64, 0.58, 0.46), (0.40, 0.40, 0.40))
LAND_STEP = 0.05  # metres from the near ground down to the far ground

# Probability that a material has a texture cropped from an image, if there are any.
PHOTO_PROBABILITY = 0.5


class Cut(NamedTuple):
    """What is cut out of a box, ellipsoid or cylinder: the fields of `Scene` for one solid."""

    shape: int
    frame: np.ndarray  # [3, 4]


NO_CUT = Cut(UNCUT, np.zeros((3, 4)))


class Solid(NamedTuple):
    """A solid in world coordinates; the fields are those of `Scene` for one solid."""

    shape: int
    centre: np.ndarray
    axes: np.ndarray
    halves: np.ndarray
    cut: Cut
    waves: np.ndarray
    form: tuple[float, float]
    materials: tuple[int, ...]


@dataclass(frozen=True)
class Layout:
    """A scene, and the boxes in which camera centres and look-at points lie: lower and upper corner, [2, 3]."""

    scene: Scene
    eye_bounds: np.ndarray
    focus_bounds: np.ndarray


@dataclass
class SceneBuilder:
    """Collects solids and materials. What is added is placed in the builder's frame, at `position`, turned by `yaw`."""

    rng: np.random.Generator
    textures: Textures
    yaw: float = 0.0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    solids: list[Solid] = field(default_factory=list)
    materials: list[tuple[int, np.ndarray, np.ndarray, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.photos = self.textures.of_kind(PHOTO_KIND)

    def material(self, *kinds: str, period: float | None = None, emission: float = 0.0) -> int:
        """Add a material with a randomly recolored texture of one of `kinds`; returns its index.

        period: of the texture, in metres, by default random. emission: emitted light.
        """
        rng = self.rng
        kind = kinds[rng.integers(len(kinds))]
        choices = self.photos if self.photos and rng.random() < PHOTO_PROBABILITY else self.textures.of_kind(kind)
        texture = choices[rng.integers(len(choices))]
        frequency = 1 / (period or np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
        angle = rng.integers(4) * np.pi / 2 if rng.random() < 0.85 else rng.uniform(0, 2 * np.pi)
        angle *= kind not in ("brick", "glyphs", "wood")
        cos, sin = np.cos(angle) * frequency, np.sin(angle) * frequency
        uv = np.array([[cos, -sin, rng.random()], [sin, cos, rng.random()]])
        contrast = rng.uniform(0.5, 1.0)
        mix = np.eye(3) if rng.random() < 0.5 else np.eye(3)[rng.permutation(3)]
        colour = np.empty((3, 4))
        colour[:, :3] = mix * (contrast * rng.uniform(0.85, 1.1, 3))[:, None]
        colour[:, 3] = (1 - contrast) * rng.uniform(0.1, 0.9)
        specular = rng.uniform(0.05, 0.35) if rng.random() < 0.2 else 0.0
        self.materials.append((texture, uv, colour, specular, emission))
        return len(self.materials) - 1

    def tinted(
        self,
        kinds: tuple[str, ...],
        period: float,
        dark: tuple[float, ...],
        bright: tuple[float, ...],
        emission: float = 0.0,
    ) -> int:
        """Add a dull material from colour `dark` to `bright`, by the brightness of a texture; returns its index.

        period: of the texture, in metres. emission: emitted light.
        """
        rng = self.rng
        choices = self.textures.of_kind(*kinds)
        texture = choices[rng.integers(len(choices))]
        uv = np.array([[1 / period, 0.0, rng.random()], [0.0, 1 / period, rng.random()]])
        colour = np.empty((3, 4))
        colour[:, :3] = (np.subtract(bright, dark) / 3)[:, None]
        colour[:, 3] = dark
        self.materials.append((texture, uv, colour, 0.0, emission))
        return len(self.materials) - 1

    def add(
        self,
        shape: int,
        centre: tuple[float, float, float],
        half: tuple[float, float, float],
        materials: int | tuple[int, ...],
        axes: np.ndarray | None = None,
        cut: Cut = NO_CUT,
        squareness: float = 0.0,
        bumps: float = 0.0,
    ) -> None:
        """Add a solid at `centre` with half extents `half`, both in the builder's frame.

        materials: one, or those of the six faces as in `Scene.materials`. axes: rows, the solid's axes. cut: what is
        cut out of a box, ellipsoid or cylinder. Height fields have random waves. Of a free-form solid, squareness is 0
        for a ball and 1 for a rounded cube, and bumps are the amplitude of its waves in the unit frame, below 0.4.
        """
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        frame = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])  # rows: the frame's axes
        rotated = frame if axes is None else axes @ frame
        faces = (materials,) * 6 if isinstance(materials, int) else materials
        waves, steepness = np.zeros((WAVES, 5)), 0.0
        if shape == HEIGHT_FIELD:
            waves[:, :4] = _random_waves(self.rng)
        elif shape == FREE_FORM:
            waves = _random_form(self.rng, bumps)
            steepness = form_steepness(waves)
        place = np.array(centre) @ frame + self.position
        form = (squareness, steepness)
        self.solids.append(Solid(shape, place, rotated, np.array(half, float), cut, waves, form, faces))

    def box(self, x: float, y: float, z: float, half_x: float, half_y: float, half_z: float, material: int) -> None:
        """Add a box at (x, y, z) whose axes are those of the builder's frame."""
        self.add(BOX, (x, y, z), (half_x, half_y, half_z), material)

    def scene(self, lights: list[tuple[np.ndarray, np.ndarray, float, float]], ambient: np.ndarray) -> Scene:
        """The scene with all solids that were added. lights: (position, colour, reach, half length), as in `Scene`."""
        shapes, centres, axes, halves, cuts, waves, forms, faces = zip(*self.solids, strict=True)
        cut_shapes, cut_frames = zip(*cuts, strict=True)
        textures, uv, colours, speculars, emissions = zip(*self.materials, strict=True)
        positions, light_colours, reaches, lengths = zip(*lights, strict=True)
        return Scene(
            np.array(shapes),
            np.array(centres),
            np.array(axes),
            np.array(halves),
            np.array(cut_shapes),
            np.array(cut_frames),
            np.array(waves),
            np.array(forms),
            np.array(faces),
            np.array(textures),
            np.array(uv),
            np.array(colours),
            np.linalg.norm(np.array(uv)[:, :, 0], axis=1),
            np.array(speculars),
            np.array(emissions),
            np.array(positions),
            np.array(light_colours),
            np.array(reaches, float),
            np.array(lengths, float),
            ambient,
        )


def add_open_ground(builder: SceneBuilder, *ground_kinds: str) -> float:
    """Add ground and sky as the enclosing box; returns its half extent in x and z."""
    rng = builder.rng
    reach = rng.uniform(18, 45)
    sky = builder.material("gradient", "noise", "plain", period=reach * rng.uniform(0.7, 2.0), emission=0.25)
    ground = builder.material(*ground_kinds, period=rng.uniform(1.5, 5.0))
    builder.add(BOX, (0, -reach / 2, 0), (reach, reach / 2, reach), (sky, sky, sky, ground, sky, sky))
    return float(reach)


def add_ground_and_sky(builder: SceneBuilder, distance: float, *ground_kinds: str) -> float:
    """Add ground and a sky that is far or, in some scenes, that of `add_open_ground`.

    distance: from which the scene is seen, in metres. Returns the half extent in x and z of the ground on which objects
    may stand, in metres. With a far sky, a far ground reaches from there to the horizon.
    """
    rng = builder.rng
    if rng.random() > FAR_SKY_PROBABILITY:
        return add_open_ground(builder, *ground_kinds)
    reach = distance * np.exp(rng.uniform(*np.log(SKY_DISTANCE)))
    below, above = SKIES[rng.integers(len(SKIES))]
    sky = builder.tinted(("noise", "gradient", "plain"), reach * rng.uniform(0.8, 3.0), below, above, LUMINOUS)
    builder.add(ELLIPSOID, (0, 0, 0), (reach, reach, reach), sky)
    # A texture as fine as that of the near ground would alias towards the horizon: mipmaps end at four texels a period.
    near = min(rng.uniform(18, 45), 0.5 * reach)
    land = np.array(LANDS[rng.integers(len(LANDS))])
    far_ground = builder.tinted(("noise", "plain"), reach * rng.uniform(0.1, 0.4), tuple(0.8 * land), tuple(1.2 * land))
    builder.add(BOX, (0, 1 + LAND_STEP, 0), (reach, 1, reach), far_ground)
    ground = builder.material(*ground_kinds, period=rng.uniform(1.5, 5.0))
    builder.add(BOX, (0, 1, 0), (near, 1, near), ground)
    _add_far_hills(builder, reach, land, np.array(below))
    return float(near)


def _add_far_hills(builder: SceneBuilder, reach: float, land: np.ndarray, haze: np.ndarray) -> None:
    """Add hills between the ground and the horizon, the hazier the farther. reach: radius of the sky in metres.

    land, haze: colours RGB, [3].
    """
    rng = builder.rng
    for _ in range(rng.integers(0, 7)):
        bearing, distance = rng.uniform(0, 2 * np.pi), reach * rng.uniform(0.5, 0.85)
        shade = land + (haze - land) * distance / reach
        hill = builder.tinted(("noise", "strokes", "cells"), 0.1 * reach, tuple(0.8 * shade), tuple(1.1 * shade))
        half = reach * np.array([rng.uniform(0.05, 0.3), rng.uniform(0.01, 0.06), rng.uniform(0.05, 0.1)])
        turn = rng.uniform(0, 2 * np.pi)
        axes = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        centre = (distance * np.cos(bearing), 0.0, distance * np.sin(bearing))
        builder.add(ELLIPSOID, centre, tuple(half), hill, axes)


def add_room(builder: SceneBuilder, height_factor: float = 1.0) -> tuple[float, float, float]:
    """Add a room as the enclosing box; returns its width (x), height (y) and length (z)."""
    rng = builder.rng
    width, height, length = rng.uniform(3.2, 7.5), rng.uniform(2.4, 3.2) * height_factor, rng.uniform(3.5, 8.0)
    walls = builder.material(*WALL_KINDS, period=rng.uniform(1.0, 3.0))
    accent = builder.material(*WALL_KINDS, period=rng.uniform(1.0, 3.0)) if rng.random() < 0.5 else walls
    floor = builder.material(*FLOOR_KINDS, period=rng.uniform(0.8, 2.5))
    ceiling = builder.material("plain", "plain", "wood", "checker", period=rng.uniform(1.0, 3.0))
    faces = (walls, accent, ceiling, floor, walls, accent)
    builder.add(BOX, (0, -height / 2, 0), (width / 2, height / 2, length / 2), faces)
    return width, height, length


def sunlit_scene(builder: SceneBuilder) -> Scene:
    """The scene lit by sun and sky; some scenes have shadows."""
    rng = builder.rng
    distance = max(SUN_DISTANCE, SUN_RADII * builder.solids[0].halves.max())
    sun = rng.normal(0, 1, 3) * (1, 0.3, 1) - (0, 1.2, 0)
    half_length = SUN_WIDTH * distance if rng.random() < 0.4 else -1.0
    lights = [(distance * sun / np.linalg.norm(sun), rng.uniform(0.5, 0.8) * _light_colour(rng), 1e9, half_length)]
    return builder.scene(lights, rng.uniform(0.35, 0.55) * _light_colour(rng))


def lamplit_scene(builder: SceneBuilder, width: float, height: float, length: float) -> Scene:
    """The scene lit by one or two lamps under the ceiling; some scenes have shadows."""
    rng = builder.rng
    shadows = rng.random() < 0.4
    count = rng.integers(1, 3)
    lights = []
    for index in range(count):
        position = np.array([rng.uniform(-0.3, 0.3) * width, -0.93 * height, rng.uniform(-0.3, 0.3) * length])
        half_length = rng.uniform(0.02, 0.2) if shadows and index == 0 else -1.0
        lights.append(
            (position, rng.uniform(0.5, 0.95) / count**0.5 * _light_colour(rng), rng.uniform(2.5, 6.0), half_length)
        )
    return builder.scene(lights, rng.uniform(0.35, 0.6) * _light_colour(rng))


def daylit_scene(builder: SceneBuilder, width: float, height: float, length: float, windows: list[np.ndarray]) -> Scene:
    """The scene lit by windows, and in some scenes faintly by a lamp, too: darker the farther from the windows.

    windows: positions of their lights, of which some have soft shadows. width, height, length: of the room in metres.
    """
    rng = builder.rng
    reach = rng.uniform(1.2, 0.6 * max(width, length))
    daylight = (rng.uniform(1.0, 1.8) / len(windows) ** 0.5) * _light_colour(rng)
    half_length = rng.uniform(0.2, 0.5) if rng.random() < 0.6 else -1.0
    lights = [(position, daylight, reach, half_length) for position in windows]
    if rng.random() < 0.3:
        lights.append((np.array([0, -0.93 * height, 0]), rng.uniform(0.1, 0.3) * _light_colour(rng), reach, -1.0))
    return builder.scene(lights, rng.uniform(0.12, 0.3) * _light_colour(rng))


def _random_waves(rng: np.random.Generator) -> np.ndarray:
    """Waves of a height field, as in `Scene.waves`: each finer and lower than the one before; heights within .9."""
    frequencies = np.sort(rng.uniform(*WAVE_PERIODS, WAVES))
    bearing = rng.uniform(0, 2 * np.pi, WAVES)
    heights = WAVE_DECAY ** np.arange(WAVES)
    columns = frequencies * np.cos(bearing), frequencies * np.sin(bearing), rng.random(WAVES), heights
    waves = np.stack(columns, axis=1)
    waves[:, 3] *= 0.9 / heights.sum()
    return waves


def _random_form(rng: np.random.Generator, bumps: float) -> np.ndarray:
    """Waves of a free-form solid, as in `Scene.waves`: each finer and lower than the one before.

    bumps: the sum of the amplitudes. The solid stays in its unit cube, since the waves only take away from it: at most
    2 `bumps` of its radius.
    """
    frequencies = np.sort(rng.uniform(*FORM_PERIODS, WAVES)) / 2  # per unit of length
    directions = rng.normal(0, 1, (WAVES, 3))
    directions *= (frequencies / np.linalg.norm(directions, axis=1))[:, None]
    heights = WAVE_DECAY ** np.arange(WAVES)
    heights *= bumps / heights.sum()
    return np.column_stack([directions[:, 0], directions[:, 2], rng.random(WAVES), heights, directions[:, 1]])


def form_steepness(waves: np.ndarray) -> float:
    """Upper bound of the slope of a free-form solid's implicit function in the unit frame. waves: [WAVES, 5].

    Norms have slopes of at most 1, and a wave of amplitude a and frequency |k| has one of at most 8 a |k|.
    """
    return float(1 + 8 * (waves[:, 3] * np.linalg.norm(waves[:, [0, 1, 4]], axis=1)).sum())


def cut_out(
    shape: int, centre: tuple[float, float, float], half: tuple[float, float, float], axes: np.ndarray | None = None
) -> Cut:
    """A box, ellipsoid or cylinder to cut out of a solid; all lengths are in the unit frame of that solid.

    half: half extents along `axes`, of which the rows are unit vectors; by default those of the solid.
    """
    rows = (np.eye(3) if axes is None else axes) / np.array(half)[:, None]
    return Cut(shape, np.column_stack([rows, -rows @ np.array(centre)]))


def _light_colour(rng: np.random.Generator) -> np.ndarray:
    """The colour of a light, from cool to warm."""
    warmth = rng.normal(0, 0.08)
    return np.array([1 + warmth, 1.0, 1 - warmth])


def random_rotation(rng: np.random.Generator, spread: float = 3.0) -> np.ndarray:
    """A rotation matrix about a random axis by a normally distributed angle of standard deviation `spread`, radians."""
    x, y, z = rng.normal(0, 1, 3)
    norm, angle = np.sqrt(x * x + y * y + z * z), rng.normal(0, spread)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / norm
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
