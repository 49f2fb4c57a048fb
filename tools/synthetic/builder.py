"""A builder of synthetic scenes: solids with materials, enclosing rooms or open ground, and lights.

y points down and the floor is at y = 0, so that heights are negative. Lengths are metres until a sample is scaled.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .raycast import BOX, HEIGHT_FIELD
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

NO_CUT = (0.0, 0.0, 0.0, 0.0)
# Periods of a height field's waves along its sides of length 2, and how much lower each wave is than the one before.
WAVE_PERIODS, WAVE_DECAY = (0.3, 1.5), 0.6

# Probability that a material has a texture cropped from an image, if there are any.
PHOTO_PROBABILITY = 0.5


class Solid(NamedTuple):
    """A solid in world coordinates; the fields are those of `Scene` for one solid."""

    shape: int
    centre: np.ndarray
    axes: np.ndarray
    halves: np.ndarray
    cut: tuple[float, float, float, float]
    waves: np.ndarray
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

    def add(
        self,
        shape: int,
        centre: tuple[float, float, float],
        half: tuple[float, float, float],
        materials: int | tuple[int, ...],
        axes: np.ndarray | None = None,
        cut: tuple[float, float, float, float] = NO_CUT,
    ) -> None:
        """Add a solid at `centre` with half extents `half`, both in the builder's frame.

        materials: one, or those of the six faces as in `Scene.materials`. axes: rows, the solid's axes. cut: the ball
        that is cut out, as in `Scene.cuts`. Height fields have random waves.
        """
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        frame = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])  # rows: the frame's axes
        rotated = frame if axes is None else axes @ frame
        faces = (materials,) * 6 if isinstance(materials, int) else materials
        waves = _random_waves(self.rng) if shape == HEIGHT_FIELD else np.zeros((WAVES, 4))
        place = np.array(centre) @ frame + self.position
        self.solids.append(Solid(shape, place, rotated, np.array(half, float), cut, waves, faces))

    def box(self, x: float, y: float, z: float, half_x: float, half_y: float, half_z: float, material: int) -> None:
        """Add a box at (x, y, z) whose axes are those of the builder's frame."""
        self.add(BOX, (x, y, z), (half_x, half_y, half_z), material)

    def scene(self, lights: list[tuple[np.ndarray, np.ndarray, float, float]], ambient: np.ndarray) -> Scene:
        """The scene with all solids that were added. lights: (position, colour, reach, half length), as in `Scene`."""
        shapes, centres, axes, halves, cuts, waves, faces = zip(*self.solids, strict=True)
        textures, uv, colours, speculars, emissions = zip(*self.materials, strict=True)
        positions, light_colours, reaches, lengths = zip(*lights, strict=True)
        return Scene(
            np.array(shapes),
            np.array(centres),
            np.array(axes),
            np.array(halves),
            np.array(cuts),
            np.array(waves),
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
    sun = rng.normal(0, 1, 3) * (1, 0.3, 1) - (0, 1.2, 0)
    half_length = 6.0 if rng.random() < 0.4 else -1.0
    lights = [(200 * sun / np.linalg.norm(sun), rng.uniform(0.5, 0.8) * _light_colour(rng), 1e9, half_length)]
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


def _random_waves(rng: np.random.Generator) -> np.ndarray:
    """Waves of a height field, as in `Scene.waves`: each finer and lower than the one before; heights within .9."""
    frequencies = np.sort(rng.uniform(*WAVE_PERIODS, WAVES))
    bearing = rng.uniform(0, 2 * np.pi, WAVES)
    heights = WAVE_DECAY ** np.arange(WAVES)
    columns = frequencies * np.cos(bearing), frequencies * np.sin(bearing), rng.random(WAVES), heights
    waves = np.stack(columns, axis=1)
    waves[:, 3] *= 0.9 / heights.sum()
    return waves


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
