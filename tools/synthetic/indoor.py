"""Synthetic scenes inside a room."""

import numpy as np

from .builder import (
    ANY_KINDS,
    FLOOR_KINDS,
    Layout,
    SceneBuilder,
    add_room,
    daylit_scene,
    lamplit_scene,
    random_rotation,
)
from .objects import (
    add_bowl,
    add_bright_windows,
    add_chair,
    add_crates,
    add_cup,
    add_cushion,
    add_lamp,
    add_pierced_block,
    add_plant,
    add_sculpture,
    add_small_object,
    add_stone,
    add_table,
    furnish_wall,
)
from .raycast import BOX, CYLINDER, ELLIPSOID, HEIGHT_FIELD
from .textures import Textures


def furnished_room(rng: np.random.Generator, textures: Textures) -> Layout:
    """A room with furniture along the walls and in the middle, and posters."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder)
    for wall in range(4):
        furnish_wall(builder, wall, width, height, length)
    _furnish_middle(builder, width, length)
    return Layout(lamplit_scene(builder, width, height, length), *_room_bounds(width, height, length))


def daylit_room(rng: np.random.Generator, textures: Textures) -> Layout:
    """A furnished room in which light comes from the windows of one wall: dark far from them."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder)
    bright = int(rng.integers(4))
    for wall in range(4):
        if wall != bright:
            furnish_wall(builder, wall, width, height, length)
    windows = add_bright_windows(builder, bright, width, length)
    _furnish_middle(builder, width, length)
    scene = daylit_scene(builder, width, height, length, windows)
    return Layout(scene, *_room_bounds(width, height, length))


def _furnish_middle(builder: SceneBuilder, width: float, length: float) -> None:
    """Add a carpet, a table and furniture away from the walls. width, length: of the room in metres."""
    rng = builder.rng
    builder.position, builder.yaw = (rng.uniform(-0.2, 0.2) * width, 0.0, rng.uniform(-0.2, 0.2) * length), 0.0
    if rng.random() < 0.7:
        builder.box(
            0, -0.005, 0, rng.uniform(0.8, 1.6), 0.005, rng.uniform(0.6, 1.2), builder.material("weave", "collage")
        )
    builder.yaw = rng.uniform(0, 2 * np.pi)
    add_table(builder, rng.uniform(0.4, 0.78))
    for _ in range(rng.integers(0, 4)):
        builder.position = (rng.uniform(-0.3, 0.3) * width, 0.0, rng.uniform(-0.3, 0.3) * length)
        builder.yaw = rng.uniform(0, 2 * np.pi)
        (add_chair, add_plant, add_crates, add_lamp)[rng.integers(4)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0


def _room_bounds(width: float, height: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of camera centres and of look-at points in a room, as in `Layout`."""
    eye_bounds = np.array(
        [[-0.45 * width, -min(1.9, 0.8 * height), -0.45 * length], [0.45 * width, -0.8, 0.45 * length]]
    )
    focus_bounds = np.array([[-0.3 * width, -1.2, -0.3 * length], [0.3 * width, -0.4, 0.3 * length]])
    return eye_bounds, focus_bounds


def clutter(rng: np.random.Generator, textures: Textures) -> Layout:
    """A room full of floating solids of random shape, size and rotation."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder, rng.uniform(0.8, 1.6))
    for _ in range(rng.integers(8, 26)):
        centre = tuple(rng.uniform(-0.5, 0.5, 3) * (width, height, length) - (0, height / 2, 0))
        size = np.exp(rng.uniform(np.log(0.12), np.log(0.7)))
        half = size * np.exp(rng.normal(0, 0.5, 3))
        if rng.random() < 0.35:  # a card or a pole
            half[rng.integers(3)] *= rng.choice([0.03, 5.0])
        material = builder.material(*ANY_KINDS, period=size * rng.uniform(0.8, 4.0))
        builder.add(
            int(rng.choice([BOX, BOX, ELLIPSOID, CYLINDER])), centre, tuple(half), material, random_rotation(rng)
        )
    eye_bounds = np.array(
        [[-0.48 * width, -0.9 * height, -0.48 * length], [0.48 * width, -0.1 * height, 0.48 * length]]
    )
    return Layout(
        lamplit_scene(builder, width, height, length), eye_bounds, 0.6 * eye_bounds + 0.4 * eye_bounds.mean(axis=0)
    )


def table_top(rng: np.random.Generator, textures: Textures) -> Layout:
    """Small objects on a table, seen from nearby."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder)
    top = 0.75
    board = builder.material(*FLOOR_KINDS, period=rng.uniform(0.4, 1.2))
    builder.box(0, -top + 0.02, 0, rng.uniform(0.5, 1.2), 0.02, rng.uniform(0.4, 0.8), board)
    builder.box(0, -top / 2 + 0.03, 0, 0.06, top / 2 - 0.03, 0.06, builder.material("wood", "plain"))
    for _ in range(rng.integers(6, 16)):
        builder.position = (rng.uniform(-0.5, 0.5), -top, rng.uniform(-0.4, 0.4))
        builder.yaw = rng.uniform(0, 2 * np.pi)
        add_small_object(builder, rng.uniform(0.04, 0.14))
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-1.1, -top - 0.9, -1.1], [1.1, -top - 0.12, 1.1]])
    focus_bounds = np.array([[-0.2, -top - 0.1, -0.2], [0.2, -top, 0.2]])
    return Layout(lamplit_scene(builder, width, height, length), eye_bounds, focus_bounds)


def cards(rng: np.random.Generator, textures: Textures) -> Layout:
    """Flat cards and poles at many depths in front of a slanted wall: strong parallax and occlusion."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder, rng.uniform(1.0, 1.5))
    wall = builder.material(*ANY_KINDS, period=rng.uniform(0.8, 3.0))
    builder.yaw = rng.uniform(-0.5, 0.5)
    builder.box(0, -height / 2, 0.35 * length, width, height, 0.02, wall)
    builder.yaw = 0.0
    for _ in range(rng.integers(6, 18)):
        depth = rng.uniform(-0.3, 0.3) * length
        centre = (rng.uniform(-0.4, 0.4) * width, -rng.uniform(0.05, 0.95) * height, depth)
        size = rng.uniform(0.12, 0.6)
        thin = rng.random() < 0.3
        half = (0.03, rng.uniform(0.5, 1.5), 0.03) if thin else (size, size * rng.uniform(0.5, 1.6), 0.008)
        tilt = random_rotation(rng, 0.4)
        builder.add(BOX, centre, half, builder.material(*ANY_KINDS, period=2 * size * rng.uniform(0.5, 2)), tilt)
    eye_bounds = np.array([[-0.3 * width, -0.8 * height, -0.48 * length], [0.3 * width, -0.2 * height, -0.35 * length]])
    focus_bounds = np.array([[-0.1 * width, -0.7 * height, 0.2 * length], [0.1 * width, -0.3 * height, 0.3 * length]])
    return Layout(lamplit_scene(builder, width, height, length), eye_bounds, focus_bounds)


def covered_table(rng: np.random.Generator, textures: Textures) -> Layout:
    """A table under a creased cloth, with bowls, cups, fruit and boxes on it, seen from nearby."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder)
    top, crease = 0.75, rng.uniform(0.005, 0.04)
    cloth = builder.material("weave", "stripes", "checker", "plain", "collage", period=rng.uniform(0.2, 1.0))
    builder.add(HEIGHT_FIELD, (0, -top, 0), (rng.uniform(0.5, 1.0), crease, rng.uniform(0.4, 0.8)), cloth)
    builder.box(0, -top / 2, 0, 0.4, top / 2 - crease, 0.3, builder.material("wood", "plain"))
    for _ in range(rng.integers(4, 12)):
        builder.position = (rng.uniform(-0.45, 0.45), -top, rng.uniform(-0.35, 0.35))
        builder.yaw = rng.uniform(0, 2 * np.pi)
        (add_bowl, add_cup, add_small_object, add_stone)[rng.integers(4)](builder, rng.uniform(0.04, 0.14))
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-1.0, -top - 0.8, -1.0], [1.0, -top - 0.15, 1.0]])
    focus_bounds = np.array([[-0.2, -top - 0.1, -0.2], [0.2, -top, 0.2]])
    return Layout(lamplit_scene(builder, width, height, length), eye_bounds, focus_bounds)


def still_life(rng: np.random.Generator, textures: Textures) -> Layout:
    """Hollow blocks, pipes, bags, cushions and stones on a table, in lamp light or in front of a window."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder)
    windows = add_bright_windows(builder, int(rng.integers(4)), width, length) if rng.random() < 0.5 else []
    builder.yaw, top = 0.0, 0.75
    builder.position = (0.0, 0.0, 0.0)
    board = builder.material(*FLOOR_KINDS, period=rng.uniform(0.4, 1.2))
    builder.box(0, -top + 0.02, 0, rng.uniform(0.5, 1.2), 0.02, rng.uniform(0.4, 0.8), board)
    builder.box(0, -top / 2 + 0.03, 0, 0.06, top / 2 - 0.03, 0.06, builder.material("wood", "plain"))
    kinds = (add_stone, add_stone, add_cushion, add_sculpture, add_pierced_block, add_pierced_block)
    for _ in range(rng.integers(5, 14)):
        builder.position = (rng.uniform(-0.45, 0.45), -top, rng.uniform(-0.35, 0.35))
        builder.yaw = rng.uniform(0, 2 * np.pi)
        (*kinds, add_bowl, add_cup)[rng.integers(len(kinds) + 2)](builder, rng.uniform(0.04, 0.14))
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    lit = daylit_scene(builder, width, height, length, windows) if windows else None
    eye_bounds = np.array([[-1.0, -top - 0.8, -1.0], [1.0, -top - 0.15, 1.0]])
    focus_bounds = np.array([[-0.2, -top - 0.1, -0.2], [0.2, -top, 0.2]])
    return Layout(lit or lamplit_scene(builder, width, height, length), eye_bounds, focus_bounds)


def bars(rng: np.random.Generator, textures: Textures) -> Layout:
    """A railing, a grid or wires before a wall and objects: structures of few pixels before a far background."""
    builder = SceneBuilder(rng, textures)
    width, height, length = add_room(builder, rng.uniform(1.0, 1.5))
    builder.yaw = rng.uniform(-0.6, 0.6)
    shape, thickness = int(rng.choice([BOX, CYLINDER])), rng.uniform(0.006, 0.04)
    metal = builder.material("plain", "plain", "wood", "noise", period=0.3)
    gap, reach = rng.uniform(0.12, 0.4), 0.45 * width
    for x in np.arange(-reach, reach, gap):
        builder.add(shape, (x, -height / 2, 0), (thickness, height / 2, thickness), metal)
    upright = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])  # the solid's y along x
    heights = np.arange(0.2, height, gap) if rng.random() < 0.5 else rng.uniform(0.2, 0.9, 2) * height
    for y in heights:
        builder.add(shape, (0, -y, 0), (thickness, reach, thickness), metal, upright)
    for _ in range(rng.integers(3, 9)):
        side = rng.uniform(0.5, 2.0) if rng.random() < 0.8 else -0.5
        builder.position, builder.yaw = (rng.uniform(-0.35, 0.35) * width, 0.0, side), rng.uniform(0, 2 * np.pi)
        (add_chair, add_plant, add_crates, add_lamp)[rng.integers(4)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-0.3 * width, -0.8 * height, -0.48 * length], [0.3 * width, -0.3 * height, -0.25 * length]])
    focus_bounds = np.array([[-0.2 * width, -0.6 * height, 0.0], [0.2 * width, -0.3 * height, 0.2 * length]])
    return Layout(lamplit_scene(builder, width, height, length), eye_bounds, focus_bounds)
