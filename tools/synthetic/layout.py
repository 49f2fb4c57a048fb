"""Scenes drawn from a random generator: furnished rooms, clutter, streets, table tops, cards in the air.

y points down and the floor lies at y = 0, so that heights are negative. Lengths are metres until a sample is scaled.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .raycast import BOX, CYLINDER, ELLIPSOID, Scene
from .textures import Textures

WALL_KINDS = ("plain", "plain", "plain", "brick", "stripes", "gradient", "noise", "weave", "glyphs", "cells")
FLOOR_KINDS = ("wood", "wood", "checker", "cells", "speckle", "brick", "weave", "strokes", "noise", "plain")
GROUND_KINDS = ("cells", "strokes", "noise", "brick", "speckle")
FURNITURE_KINDS = ("wood", "wood", "plain", "noise", "weave", "stripes", "gradient", "speckle")
PICTURE_KINDS = ("collage", "collage", "glyphs", "gradient", "noise", "weave")
ANY_KINDS = (
    *("noise", "plain", "brick", "checker", "wood", "stripes", "speckle"),
    *("glyphs", "gradient", "cells", "weave", "strokes", "collage"),
)

# Textures that are windows of photographs, and the share of the materials that have one, where there are any.
PHOTO_KIND, PHOTO_PROBABILITY = "photo", 0.5


@dataclass(frozen=True)
class Layout:
    """A scene and where cameras may stand in it and look to: boxes [2, 3], lower and upper corner."""

    scene: Scene
    eyes: np.ndarray
    focus: np.ndarray


@dataclass
class Builder:
    """Collects solids and materials; `yaw` and `place` move what is added, so that furniture has a frame of its own."""

    rng: np.random.Generator
    textures: Textures
    yaw: float = 0.0
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    solids: list[tuple[int, np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]] = field(default_factory=list)
    materials: list[tuple[int, np.ndarray, np.ndarray, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.photos = self.textures.of_kind(PHOTO_KIND)

    def material(self, *kinds: str, period: float | None = None, glow: float = 0.0) -> int:
        """Add a material with a texture of one of `kinds`, recoloured; `period`: its size in metres."""
        rng = self.rng
        kind = kinds[rng.integers(len(kinds))]
        choices = self.photos if self.photos and rng.random() < PHOTO_PROBABILITY else self.textures.of_kind(kind)
        texture = choices[rng.integers(len(choices))]
        frequency = 1 / (period or np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
        turn = rng.integers(4) * np.pi / 2 if rng.random() < 0.85 else rng.uniform(0, 2 * np.pi)
        turn *= kind not in ("brick", "glyphs", "wood")
        cos, sin = np.cos(turn) * frequency, np.sin(turn) * frequency
        uv = np.array([[cos, -sin, rng.random()], [sin, cos, rng.random()]])
        contrast = rng.uniform(0.5, 1.0)
        mix = np.eye(3) if rng.random() < 0.5 else np.eye(3)[rng.permutation(3)]
        colour = np.empty((3, 4))
        colour[:, :3] = mix * (contrast * rng.uniform(0.85, 1.1, 3))[:, None]
        colour[:, 3] = (1 - contrast) * rng.uniform(0.1, 0.9)
        gloss = rng.uniform(0.05, 0.35) if rng.random() < 0.2 else 0.0
        self.materials.append((texture, uv, colour, gloss, glow))
        return len(self.materials) - 1

    def add(
        self,
        shape: int,
        centre: tuple[float, float, float],
        half: tuple[float, float, float],
        materials: int | tuple[int, ...],
        axes: np.ndarray | None = None,
    ) -> None:
        """Add a solid at `centre` with half extents `half`, turned within the builder's frame.

        axes: rows, the solid's own axes there.
        """
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        frame = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])  # rows: the frame's axes
        turned = frame if axes is None else axes @ frame
        faces = (materials,) * 6 if isinstance(materials, int) else materials
        self.solids.append((shape, np.array(centre) @ frame + self.place, turned, np.array(half, float), faces))

    def box(self, x: float, y: float, z: float, half_x: float, half_y: float, half_z: float, material: int) -> None:
        """Add a box that stands upright in the builder's frame."""
        self.add(BOX, (x, y, z), (half_x, half_y, half_z), material)

    def scene(self, lights: list[tuple[np.ndarray, np.ndarray, float, float]], ambient: np.ndarray) -> Scene:
        """What was collected, with `lights` as (position, colour, reach, half length); see `Scene`."""
        shapes, centres, axes, halves, faces = zip(*self.solids, strict=True)
        textures, uv, colours, glosses, glows = zip(*self.materials, strict=True)
        positions, light_colours, reaches, lengths = zip(*lights, strict=True)
        return Scene(
            np.array(shapes),
            np.array(centres),
            np.array(axes),
            np.array(halves),
            np.array(faces),
            np.array(textures),
            np.array(uv),
            np.array(colours),
            np.linalg.norm(np.array(uv)[:, :, 0], axis=1),
            np.array(glosses),
            np.array(glows),
            np.array(positions),
            np.array(light_colours),
            np.array(reaches, float),
            np.array(lengths, float),
            ambient,
        )


def generate_layout(rng: np.random.Generator, textures: Textures, outdoors: bool = False) -> Layout:
    """A scene of a random kind; outdoors: with those kinds that are seen from outside, from above or all around."""
    layouts = LAYOUTS + OUTDOOR_LAYOUTS if outdoors else LAYOUTS
    return layouts[rng.integers(len(layouts))](rng, textures)


def _open_ground(build: Builder, *ground_kinds: str) -> float:
    """Add ground and sky; returns how far the sky is."""
    rng = build.rng
    reach = rng.uniform(18, 45)
    sky = build.material("gradient", "noise", "plain", period=reach * rng.uniform(0.7, 2.0), glow=0.25)
    ground = build.material(*ground_kinds, period=rng.uniform(1.5, 5.0))
    build.add(BOX, (0, -reach / 2, 0), (reach, reach / 2, reach), (sky, sky, sky, ground, sky, sky))
    return float(reach)


def _sunlight(build: Builder) -> Scene:
    """The scene lit by the sun, in a part of the scenes with shadows, and by the sky."""
    rng = build.rng
    sun = rng.normal(0, 1, 3) * (1, 0.3, 1) - (0, 1.2, 0)
    half_length = 6.0 if rng.random() < 0.4 else -1.0
    lights = [(200 * sun / np.linalg.norm(sun), rng.uniform(0.5, 0.8) * _tone(rng), 1e9, half_length)]
    return build.scene(lights, rng.uniform(0.35, 0.55) * _tone(rng))


def furnished_room(rng: np.random.Generator, textures: Textures) -> Layout:
    """A room with furniture along the walls and in the middle, pictures, a lamp."""
    build = Builder(rng, textures)
    width, height, length = _room(build)
    for wall in range(4):
        _furnish_wall(build, wall, width, height, length)
    build.place, build.yaw = (rng.uniform(-0.2, 0.2) * width, 0.0, rng.uniform(-0.2, 0.2) * length), 0.0
    if rng.random() < 0.7:
        build.box(0, -0.005, 0, rng.uniform(0.8, 1.6), 0.005, rng.uniform(0.6, 1.2), build.material("weave", "collage"))
    build.yaw = rng.uniform(0, 2 * np.pi)
    _table(build, rng.uniform(0.4, 0.78))
    for _ in range(rng.integers(0, 4)):
        build.place = (rng.uniform(-0.3, 0.3) * width, 0.0, rng.uniform(-0.3, 0.3) * length)
        build.yaw = rng.uniform(0, 2 * np.pi)
        (_chair, _plant, _crates, _lamp)[rng.integers(4)](build)
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    eyes = np.array([[-0.45 * width, -min(1.9, 0.8 * height), -0.45 * length], [0.45 * width, -0.8, 0.45 * length]])
    focus = np.array([[-0.3 * width, -1.2, -0.3 * length], [0.3 * width, -0.4, 0.3 * length]])
    return Layout(_indoor_light(build, width, height, length), eyes, focus)


def _clutter(rng: np.random.Generator, textures: Textures) -> Layout:
    """A room full of solids in the air, of any shape, size and turn."""
    build = Builder(rng, textures)
    width, height, length = _room(build, rng.uniform(0.8, 1.6))
    for _ in range(rng.integers(8, 26)):
        centre = tuple(rng.uniform(-0.5, 0.5, 3) * (width, height, length) - (0, height / 2, 0))
        size = np.exp(rng.uniform(np.log(0.12), np.log(0.7)))
        half = size * np.exp(rng.normal(0, 0.5, 3))
        if rng.random() < 0.35:  # a card or a pole
            half[rng.integers(3)] *= rng.choice([0.03, 5.0])
        material = build.material(*ANY_KINDS, period=size * rng.uniform(0.8, 4.0))
        build.add(int(rng.choice([BOX, BOX, ELLIPSOID, CYLINDER])), centre, tuple(half), material, _rotation(rng))
    eyes = np.array([[-0.48 * width, -0.9 * height, -0.48 * length], [0.48 * width, -0.1 * height, 0.48 * length]])
    return Layout(_indoor_light(build, width, height, length), eyes, 0.6 * eyes + 0.4 * eyes.mean(axis=0))


def _street(rng: np.random.Generator, textures: Textures) -> Layout:
    """Open ground with buildings, trees, poles and boxes under a far sky."""
    build = Builder(rng, textures)
    reach = _open_ground(build, *GROUND_KINDS)
    for _ in range(rng.integers(2, 7)):
        half_x, half_y, half_z = rng.uniform(1, 4), rng.uniform(1.2, 6), rng.uniform(1, 4)
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(6, 0.8 * reach)
        build.place, build.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        wall = build.material("brick", "checker", "plain", "wood", "cells", "stripes", period=rng.uniform(1, 4))
        build.box(0, -half_y, 0, half_x, half_y, half_z, wall)
        pane = build.material("plain", "gradient", "collage")
        for storey in range(int(half_y)):
            build.box(rng.uniform(-0.3, 0.3) * half_x, -2 * storey - 1.4, 0, 0.4 * half_x, 0.5, half_z + 0.03, pane)
    for _ in range(rng.integers(5, 14)):
        bearing, distance = rng.uniform(0, 2 * np.pi), 1 + rng.uniform(0, 9)
        build.place, build.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        (_tree, _pole, _crates, _crates, _fence)[rng.integers(5)](build)
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    eyes = np.array([[-8, -2.5, -8], [8, -1.0, 8]])
    return Layout(_sunlight(build), eyes, np.array([[-4, -2.0, -4], [4, -0.3, 4]]))


def _table_top(rng: np.random.Generator, textures: Textures) -> Layout:
    """Small things on a table, seen from nearby."""
    build = Builder(rng, textures)
    width, height, length = _room(build)
    top = 0.75
    board = build.material(*FLOOR_KINDS, period=rng.uniform(0.4, 1.2))
    build.box(0, -top + 0.02, 0, rng.uniform(0.5, 1.2), 0.02, rng.uniform(0.4, 0.8), board)
    build.box(0, -top / 2 + 0.03, 0, 0.06, top / 2 - 0.03, 0.06, build.material("wood", "plain"))
    for _ in range(rng.integers(6, 16)):
        build.place = (rng.uniform(-0.5, 0.5), -top, rng.uniform(-0.4, 0.4))
        build.yaw = rng.uniform(0, 2 * np.pi)
        _thing(build, rng.uniform(0.04, 0.14))
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    eyes = np.array([[-1.1, -top - 0.9, -1.1], [1.1, -top - 0.12, 1.1]])
    focus = np.array([[-0.2, -top - 0.1, -0.2], [0.2, -top, 0.2]])
    return Layout(_indoor_light(build, width, height, length), eyes, focus)


def _cards(rng: np.random.Generator, textures: Textures) -> Layout:
    """Flat cards, poles and a slanted wall at many depths before one side: parallax and occlusion, little else."""
    build = Builder(rng, textures)
    width, height, length = _room(build, rng.uniform(1.0, 1.5))
    wall = build.material(*ANY_KINDS, period=rng.uniform(0.8, 3.0))
    build.yaw = rng.uniform(-0.5, 0.5)
    build.box(0, -height / 2, 0.35 * length, width, height, 0.02, wall)
    build.yaw = 0.0
    for _ in range(rng.integers(6, 18)):
        depth = rng.uniform(-0.3, 0.3) * length
        centre = (rng.uniform(-0.4, 0.4) * width, -rng.uniform(0.05, 0.95) * height, depth)
        size = rng.uniform(0.12, 0.6)
        thin = rng.random() < 0.3
        half = (0.03, rng.uniform(0.5, 1.5), 0.03) if thin else (size, size * rng.uniform(0.5, 1.6), 0.008)
        tilt = _rotation(rng, 0.4)
        build.add(BOX, centre, half, build.material(*ANY_KINDS, period=2 * size * rng.uniform(0.5, 2)), tilt)
    eyes = np.array([[-0.3 * width, -0.8 * height, -0.48 * length], [0.3 * width, -0.2 * height, -0.35 * length]])
    focus = np.array([[-0.1 * width, -0.7 * height, 0.2 * length], [0.1 * width, -0.3 * height, 0.3 * length]])
    return Layout(_indoor_light(build, width, height, length), eyes, focus)


def _facade(rng: np.random.Generator, textures: Textures) -> Layout:
    """The front of a building with windows in recesses, ledges, columns and doors, and what stands before it."""
    build = Builder(rng, textures)
    _open_ground(build, *GROUND_KINDS)
    wall = build.material("brick", "cells", "plain", "noise", "wood", period=rng.uniform(0.8, 3.0))
    trim, pane = build.material("plain", "noise", "speckle"), build.material("plain", "gradient", "collage")
    half_x, height, depth = rng.uniform(4, 9), rng.uniform(3, 9), rng.uniform(0.05, 0.4)
    build.box(0, -height / 2, 1.0, half_x, height / 2, 1.0, pane)
    columns, storeys = int(rng.integers(3, 8)), max(1, round(height / rng.uniform(2.2, 3.2)))
    pitch, storey = 2 * half_x / columns, height / storeys
    pier, band = rng.uniform(0.15, 0.35) * pitch, rng.uniform(0.15, 0.3) * storey
    for column in range(columns + 1):
        build.box(-half_x + column * pitch, -height / 2, -depth / 2, pier, height / 2, depth / 2, wall)
    for level in range(storeys + 1):
        build.box(0, -level * storey, -depth / 2, half_x, band, depth / 2 + 0.03, wall)
        build.box(0, -level * storey - band, -depth / 2, half_x, 0.06, depth / 2 + rng.uniform(0.03, 0.2), trim)
    for _ in range(rng.integers(2, 9)):
        build.place, build.yaw = (rng.uniform(-0.9, 0.9) * half_x, 0.0, -rng.uniform(0.6, 4.0)), rng.uniform(0, 7)
        (_plant, _pole, _crates, _fence, _tree)[rng.integers(5)](build)
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    eyes = np.array([[-0.6 * half_x, -2.2, -9.0], [0.6 * half_x, -1.2, -3.5]])
    focus = np.array([[-0.5 * half_x, -0.6 * height, 0.0], [0.5 * half_x, -0.8, 0.0]])
    return Layout(_sunlight(build), eyes, focus)


def _around_object(rng: np.random.Generator, textures: Textures) -> Layout:
    """One object of many solids that run into each other, on the ground or on a stand, seen from close by."""
    build = Builder(rng, textures)
    outside = rng.random() < 0.5
    size = _room(build) if not outside else None
    if outside:
        _open_ground(build, *GROUND_KINDS)
    top = rng.choice([0.0, rng.uniform(0.3, 0.9)])
    if top:
        stand = build.material(*FURNITURE_KINDS)
        build.add(CYLINDER, (0, -top / 2, 0), (rng.uniform(0.25, 0.6), top / 2, rng.uniform(0.25, 0.6)), stand)
    scale = rng.uniform(0.12, 0.4)
    materials = [build.material(*ANY_KINDS, period=scale * rng.uniform(0.5, 3.0)) for _ in range(rng.integers(1, 5))]
    for _ in range(rng.integers(5, 24)):
        half = scale * np.exp(rng.normal(-0.9, 0.5, 3))
        centre = tuple(rng.normal(0, 0.5, 3) * scale - (0, top + scale, 0))
        shape = int(rng.choice([BOX, ELLIPSOID, ELLIPSOID, CYLINDER]))
        build.add(shape, centre, tuple(half), materials[rng.integers(len(materials))], _rotation(rng))
    for _ in range(rng.integers(0, 5)):
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 2.5)
        build.place, build.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        (_plant, _crates, _chair)[rng.integers(3)](build)
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    bearing, distance = rng.uniform(0, 2 * np.pi), scale * rng.uniform(2.5, 5.0)
    eye = np.array([distance * np.cos(bearing), -top - scale * rng.uniform(0.5, 3.0), distance * np.sin(bearing)])
    focus = np.array([0.0, -top - scale, 0.0])
    spread = 0.3 * scale
    scene = _sunlight(build) if size is None else _indoor_light(build, *size)
    return Layout(scene, np.stack([eye - spread, eye + spread]), np.stack([focus - spread, focus + spread]))


def _from_above(rng: np.random.Generator, textures: Textures) -> Layout:
    """Houses, trees and roads, from a drone."""
    build = Builder(rng, textures)
    _open_ground(build, *GROUND_KINDS)
    for _ in range(rng.integers(1, 4)):
        build.yaw = rng.uniform(0, np.pi)
        road = build.material("plain", "noise", "speckle", period=3.0)
        build.box(rng.uniform(-6, 6), -0.01, 0, rng.uniform(0.8, 2.0), 0.02, 17, road)
    for _ in range(rng.integers(6, 22)):
        build.place, build.yaw = (rng.uniform(-12, 12), 0.0, rng.uniform(-12, 12)), rng.uniform(0, 7)
        half_x, half_y, half_z = rng.uniform(0.8, 2.5), rng.uniform(0.6, 2.5), rng.uniform(0.8, 2.5)
        wall, roof = build.material(*WALL_KINDS, period=2.0), build.material("brick", "stripes", "cells", period=1.5)
        build.box(0, -half_y, 0, half_x, half_y, half_z, wall)
        slope = rng.uniform(0.2, 0.7)
        cos, sin = np.cos(slope), np.sin(slope)
        for side in (-1, 1):
            axes = np.array([[cos, side * sin, 0], [-side * sin, cos, 0], [0, 0, 1.0]])
            centre = (side * 0.5 * half_x, -2 * half_y - 0.5 * half_x * np.tan(slope), 0)
            build.add(BOX, centre, (0.55 * half_x / cos, 0.04, 1.1 * half_z), roof, axes)
    for _ in range(rng.integers(4, 16)):
        build.place, build.yaw = (rng.uniform(-12, 12), 0.0, rng.uniform(-12, 12)), 0.0
        _tree(build)
    build.place, build.yaw = (0.0, 0.0, 0.0), 0.0
    eyes = np.array([[-10, -14.0, -10], [10, -7.0, 10]])
    return Layout(_sunlight(build), eyes, np.array([[-4, -1.0, -4], [4, 0.0, 4]]))


def _foliage(rng: np.random.Generator, textures: Textures) -> Layout:
    """Bushes and branches: many thin leaves at many depths, before a wall or open ground."""
    build = Builder(rng, textures)
    _open_ground(build, "strokes", "noise", "cells")
    if rng.random() < 0.5:
        build.box(0, -1.5, 2.5, 5, 1.5, 0.1, build.material(*WALL_KINDS, period=2.0))
    for _ in range(rng.integers(2, 5)):
        leaf = build.material("strokes", "noise", "gradient", period=rng.uniform(0.1, 0.4))
        wood = build.material("wood", "noise", period=0.3)
        place, radius = (rng.uniform(-1.5, 1.5), 0.0, rng.uniform(-0.5, 2.0)), rng.uniform(0.3, 0.7)
        build.place, length = place, rng.uniform(0.05, 0.16)
        for _ in range(rng.integers(2, 6)):
            half = rng.uniform(0.4, 0.8) * radius
            tilt = _rotation(rng, 0.6)
            build.add(CYLINDER, (rng.normal(0, 0.1), -half, rng.normal(0, 0.1)), (0.015, half, 0.015), wood, tilt)
        for _ in range(rng.integers(15, 40)):
            centre = tuple(rng.normal(0, 0.5, 3) * radius - (0, radius, 0))
            blade = length * rng.uniform(0.3, 0.6), length, 0.04 * length
            build.add(ELLIPSOID, centre, blade, leaf, _rotation(rng))
    build.place = (0.0, 0.0, 0.0)
    eyes = np.array([[-1.5, -1.7, -3.5], [1.5, -0.5, -1.8]])
    return Layout(_sunlight(build), eyes, np.array([[-0.8, -0.9, 0.0], [0.8, -0.3, 1.0]]))


OUTDOOR_LAYOUTS = (_facade, _around_object, _around_object, _from_above, _foliage)
LAYOUTS: tuple[Callable[[np.random.Generator, Textures], Layout], ...] = (
    *(furnished_room, furnished_room, furnished_room),
    *(_clutter, _clutter, _street, _table_top, _cards),
)


def _room(build: Builder, height_factor: float = 1.0) -> tuple[float, float, float]:
    """Add the enclosing room; returns its width (x), height and length (z)."""
    rng = build.rng
    width, height, length = rng.uniform(3.2, 7.5), rng.uniform(2.4, 3.2) * height_factor, rng.uniform(3.5, 8.0)
    walls = build.material(*WALL_KINDS, period=rng.uniform(1.0, 3.0))
    accent = build.material(*WALL_KINDS, period=rng.uniform(1.0, 3.0)) if rng.random() < 0.5 else walls
    floor = build.material(*FLOOR_KINDS, period=rng.uniform(0.8, 2.5))
    ceiling = build.material("plain", "plain", "wood", "checker", period=rng.uniform(1.0, 3.0))
    faces = (walls, accent, ceiling, floor, walls, accent)
    build.add(BOX, (0, -height / 2, 0), (width / 2, height / 2, length / 2), faces)
    return width, height, length


def _indoor_light(build: Builder, width: float, height: float, length: float) -> Scene:
    """The scene lit by one or two lamps under the ceiling, shadowless in a part of the scenes."""
    rng = build.rng
    shadows = rng.random() < 0.4
    count = rng.integers(1, 3)
    lights = []
    for index in range(count):
        position = np.array([rng.uniform(-0.3, 0.3) * width, -0.93 * height, rng.uniform(-0.3, 0.3) * length])
        half_length = rng.uniform(0.02, 0.2) if shadows and index == 0 else -1.0
        lights.append((position, rng.uniform(0.5, 0.95) / count**0.5 * _tone(rng), rng.uniform(2.5, 6.0), half_length))
    return build.scene(lights, rng.uniform(0.35, 0.6) * _tone(rng))


def _tone(rng: np.random.Generator) -> np.ndarray:
    """A light's colour, between warm and cool."""
    warmth = rng.normal(0, 0.08)
    return np.array([1 + warmth, 1.0, 1 - warmth])


def _rotation(rng: np.random.Generator, spread: float = 3.0) -> np.ndarray:
    """Orthonormal axes turned about a random axis by an angle of deviation `spread` (radians)."""
    x, y, z = rng.normal(0, 1, 3)
    norm, angle = np.sqrt(x * x + y * y + z * z), rng.normal(0, spread)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / norm
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _furnish_wall(build: Builder, wall: int, width: float, height: float, length: float) -> None:
    """Put furniture and pictures along one of the four walls."""
    rng = build.rng
    along, away = (width, length / 2) if wall % 2 == 0 else (length, width / 2)
    turn = wall * np.pi / 2

    def stand(offset: float, distance: float) -> None:
        """Move the builder's frame to the wall: x along it, z out of it."""
        build.yaw = turn
        cos, sin = np.cos(turn), np.sin(turn)
        x, z = offset, distance - away
        build.place = (x * cos + z * sin, 0.0, -x * sin + z * cos)

    stand(rng.uniform(-0.25, 0.25) * along, 0.0)
    (_shelf, _sofa, _cabinet, _window, _window, _crates)[rng.integers(6)](build)
    for _ in range(rng.integers(1, 3)):
        stand(rng.uniform(-0.42, 0.42) * along, 0.0)
        half_x, half_y = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.45)
        y = -min(rng.uniform(1.5, 1.9), height - half_y - 0.1)
        build.box(0, y, 0, half_x, half_y, 0.03, build.material("wood", "plain"))
        picture = build.material(*PICTURE_KINDS, period=2 * max(half_x, half_y))
        build.box(0, y, 0, 0.9 * half_x, 0.88 * half_y, 0.035, picture)
    if rng.random() < 0.5:
        stand(rng.choice([-0.43, 0.43]) * along, 0.4)
        (_plant, _lamp)[rng.integers(2)](build)


def _table(build: Builder, height: float) -> None:
    rng = build.rng
    wood = build.material(*FURNITURE_KINDS)
    half_x, half_z = rng.uniform(0.4, 0.95), rng.uniform(0.3, 0.55)
    build.box(0, -height + 0.02, 0, half_x, 0.02, half_z, wood)
    leg = rng.uniform(0.02, 0.045)
    for side_x in (-1, 1):
        for side_z in (-1, 1):
            x, z = side_x * (half_x - 2 * leg), side_z * (half_z - 2 * leg)
            build.box(x, -height / 2 + 0.02, z, leg, height / 2 - 0.02, leg, wood)
    place, yaw = build.place, build.yaw
    cos, sin = np.cos(yaw), np.sin(yaw)
    for _ in range(rng.integers(1, 5)):
        x, z = rng.uniform(-0.8, 0.8) * half_x, rng.uniform(-0.8, 0.8) * half_z
        build.place = (place[0] + x * cos + z * sin, -height, place[2] - x * sin + z * cos)
        build.yaw = rng.uniform(0, 2 * np.pi)
        _thing(build, rng.uniform(0.06, 0.16))
    build.place, build.yaw = place, yaw


def _thing(build: Builder, size: float) -> None:
    """Something that stands on a table: a book, a ball, a can, a vase, a card."""
    rng = build.rng
    material = build.material(*ANY_KINDS, period=size * rng.uniform(1.5, 4))
    y = build.place[1]
    build.place = (build.place[0], 0.0, build.place[2])
    kind = rng.integers(5)
    if kind == 0:
        thickness = 0.3 * size
        build.box(0, y - thickness, 0, size, thickness, 0.7 * size, material)
    elif kind == 1:
        build.add(ELLIPSOID, (0, y - 0.9 * size, 0), (size, 0.9 * size, size), material)
    elif kind == 2:
        build.add(CYLINDER, (0, y - size, 0), (0.55 * size, size, 0.55 * size), material)
    elif kind == 3:
        build.add(ELLIPSOID, (0, y - 0.8 * size, 0), (0.7 * size, 0.8 * size, 0.7 * size), material)
        build.add(CYLINDER, (0, y - 1.8 * size, 0), (0.2 * size, 0.5 * size, 0.2 * size), material)
    else:
        build.box(0, y - size, 0, 0.8 * size, size, 0.03 * size, material)


def _chair(build: Builder) -> None:
    material = build.material(*FURNITURE_KINDS)
    build.box(0, -0.45, 0, 0.22, 0.025, 0.22, build.material(*FURNITURE_KINDS))
    for x in (-0.19, 0.19):
        build.box(x, -0.22, 0.19, 0.02, 0.22, 0.02, material)
        build.box(x, -0.48, -0.2, 0.02, 0.48, 0.02, material)
    build.box(0, -0.8, -0.2, 0.2, 0.12, 0.015, material)


def _sofa(build: Builder) -> None:
    rng = build.rng
    cloth = build.material("weave", "noise", "plain", "stripes", "strokes", period=rng.uniform(0.3, 1.0))
    half = rng.uniform(0.7, 1.1)
    build.box(0, -0.21, 0.45, half, 0.21, 0.42, cloth)
    build.box(0, -0.45, 0.14, half, 0.4, 0.12, cloth)
    for x in (-half, half):
        build.box(x, -0.31, 0.45, 0.1, 0.31, 0.44, cloth)
    for _ in range(rng.integers(1, 4)):
        cushion = build.material(*PICTURE_KINDS, "stripes", "checker", period=0.5)
        centre = (rng.uniform(-0.7, 0.7) * half, -0.6, 0.33)
        build.add(ELLIPSOID, centre, (0.24, 0.22, 0.1), cushion, _rotation(rng, 0.2))


def _shelf(build: Builder) -> None:
    """A case with boards and books."""
    rng = build.rng
    wood = build.material("wood", "plain", period=1.0)
    half, boards, gap = rng.uniform(0.4, 0.8), int(rng.integers(3, 6)), rng.uniform(0.3, 0.4)
    books = [build.material(*ANY_KINDS, period=rng.uniform(0.1, 0.5)) for _ in range(4)]
    for x in (-half, half):
        build.box(x, -boards * gap / 2, 0.16, 0.015, boards * gap / 2, 0.16, wood)
    build.box(0, -boards * gap / 2, 0.01, half, boards * gap / 2, 0.01, build.material("plain", "wood"))
    for board in range(boards):
        y = -(board + 1) * gap
        build.box(0, y, 0.16, half, 0.012, 0.16, wood)
        x = -half + 0.03
        while x < half * rng.uniform(0.1, 1.0) and len(build.solids) < 80:
            thickness, tall = rng.uniform(0.02, 0.09), rng.uniform(0.5, 0.85) * gap / 2
            build.box(x + thickness, y + gap - 0.012 - tall, 0.17, thickness, tall, 0.11, books[rng.integers(4)])
            x += 2 * thickness + rng.choice([0.003, 0.003, 0.08])


def _cabinet(build: Builder) -> None:
    rng = build.rng
    half_x, half_y = rng.uniform(0.4, 0.9), rng.uniform(0.35, 0.6)
    build.box(0, -half_y, 0.23, half_x, half_y, 0.22, build.material(*FURNITURE_KINDS))
    door = build.material(*FURNITURE_KINDS)
    for x in (-half_x / 2, half_x / 2):
        build.box(x, -half_y, 0.46, 0.46 * half_x, 0.9 * half_y, 0.012, door)
    height = 2 * half_y
    x, _, z = build.place
    cos, sin = np.cos(build.yaw), np.sin(build.yaw)
    for offset in rng.uniform(-0.8, 0.8, rng.integers(1, 4)) * half_x:
        build.place = (x + offset * cos + 0.23 * sin, -height, z - offset * sin + 0.23 * cos)
        _thing(build, rng.uniform(0.06, 0.16))


def _window(build: Builder) -> None:
    rng = build.rng
    view = build.material("gradient", "noise", "plain", period=3.0, glow=rng.uniform(0.2, 0.5))
    frame = build.material("plain", "wood")
    half_x, half_y = rng.uniform(0.4, 0.8), rng.uniform(0.45, 0.65)
    build.box(0, -1.45, 0, half_x, half_y, 0.02, view)
    for x in (-half_x, 0, half_x):
        build.box(x, -1.45, 0.02, 0.03, half_y, 0.03, frame)
    for y in (-1.45 - half_y, -1.45 + half_y):
        build.box(0, y, 0.02, half_x + 0.03, 0.03, 0.03 + 0.05 * (y > -1.45), frame)
    curtain = build.material("stripes", "weave", "noise", "plain", period=0.6)
    for side in (-1, 1):
        build.box(side * (half_x + 0.2), -1.35, 0.05, 0.18, 0.85, 0.02, curtain)


def _lamp(build: Builder) -> None:
    height = build.rng.uniform(1.2, 1.7)
    stand = build.material("plain", "noise")
    build.add(CYLINDER, (0, -0.015, 0), (0.15, 0.015, 0.15), stand)
    build.add(CYLINDER, (0, -height / 2, 0), (0.014, height / 2, 0.014), stand)
    shade = build.material("plain", "weave", "stripes", glow=0.6)
    build.add(CYLINDER, (0, -height, 0), (0.2, 0.16, 0.2), shade)


def _plant(build: Builder) -> None:
    rng = build.rng
    build.add(CYLINDER, (0, -0.15, 0), (0.14, 0.15, 0.14), build.material("plain", "stripes", "checker", "cells"))
    leaf = build.material("strokes", "noise", period=0.3)
    for _ in range(rng.integers(4, 9)):
        centre = (rng.normal(0, 0.12), -rng.uniform(0.4, 1.0), rng.normal(0, 0.12))
        build.add(ELLIPSOID, centre, (0.07, 0.25, 0.02), leaf, _rotation(rng, 0.6))


def _crates(build: Builder) -> None:
    """A few boxes or drums on top of each other."""
    rng = build.rng
    top, size = 0.0, rng.uniform(0.15, 0.4)
    for _ in range(rng.integers(1, 4)):
        half_y = size * rng.uniform(0.5, 1.0)
        shape = int(rng.choice([BOX, BOX, CYLINDER]))
        axes = np.eye(3)
        angle = rng.normal(0, 0.3)
        axes[0, 0], axes[0, 2], axes[2, 0], axes[2, 2] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        material = build.material(*ANY_KINDS, period=2 * size)
        build.add(shape, (0, -top - half_y, 0.45), (size, half_y, size), material, axes)
        top, size = top + 2 * half_y, size * rng.uniform(0.6, 0.95)


def _tree(build: Builder) -> None:
    rng = build.rng
    height = rng.uniform(1.5, 4)
    build.add(CYLINDER, (0, -height / 2, 0), (0.15, height / 2, 0.15), build.material("wood", "noise", period=0.8))
    leaves = build.material("strokes", "noise", "cells", period=rng.uniform(0.6, 2))
    for _ in range(rng.integers(2, 6)):
        centre = (rng.normal(0, 0.6), -height - rng.uniform(-0.3, 1), rng.normal(0, 0.6))
        build.add(ELLIPSOID, centre, tuple(rng.uniform(0.5, 1.3, 3)), leaves, _rotation(rng))


def _pole(build: Builder) -> None:
    rng = build.rng
    height = rng.uniform(1.5, 4)
    build.add(CYLINDER, (0, -height / 2, 0), (0.05, height / 2, 0.05), build.material("plain", "stripes"))
    sign = build.material(*PICTURE_KINDS, period=1.0)
    build.box(0, -height, 0, rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.5), 0.06, sign)


def _fence(build: Builder) -> None:
    material = build.material("wood", "plain")
    for x in np.arange(-1.2, 1.21, 0.4):
        build.box(x, -0.5, 0, 0.05, 0.5, 0.02, material)
    for y in (-0.3, -0.8):
        build.box(0, y, 0.03, 1.3, 0.04, 0.015, material)
