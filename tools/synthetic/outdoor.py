"""Synthetic scenes in the open, or seen from outside."""

import numpy as np

from .builder import (
    ANY_KINDS,
    FURNITURE_KINDS,
    GROUND_KINDS,
    WALL_KINDS,
    Layout,
    SceneBuilder,
    add_ground_and_sky,
    add_open_ground,
    add_room,
    cut_out,
    lamplit_scene,
    random_rotation,
    sunlit_scene,
)
from .objects import (
    THROUGH,
    add_chair,
    add_crates,
    add_fence,
    add_pierced_block,
    add_pipes,
    add_plant,
    add_sculpture,
    add_sign,
    add_stone,
    add_tree,
    add_wall_with_opening,
)
from .raycast import BOX, CYLINDER, ELLIPSOID, FREE_FORM, HEIGHT_FIELD
from .textures import Textures


def street(rng: np.random.Generator, textures: Textures) -> Layout:
    """Open ground with buildings, trees, signs and boxes."""
    builder = SceneBuilder(rng, textures)
    return _street(builder, add_open_ground(builder, *GROUND_KINDS))


def street_under_far_sky(rng: np.random.Generator, textures: Textures) -> Layout:
    """A street whose sky has no parallax, in most scenes."""
    builder = SceneBuilder(rng, textures)
    return _street(builder, add_ground_and_sky(builder, 5.0, *GROUND_KINDS))


def _street(builder: SceneBuilder, reach: float) -> Layout:
    """Add buildings and objects to the ground. reach: its half extent in x and z."""
    rng = builder.rng
    for _ in range(rng.integers(2, 7)):
        half_x, half_y, half_z = rng.uniform(1, 4), rng.uniform(1.2, 6), rng.uniform(1, 4)
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(6, 0.8 * reach)
        builder.position, builder.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        wall = builder.material("brick", "checker", "plain", "wood", "cells", "stripes", period=rng.uniform(1, 4))
        builder.box(0, -half_y, 0, half_x, half_y, half_z, wall)
        pane = builder.material("plain", "gradient", "collage")
        for storey in range(int(half_y)):
            builder.box(rng.uniform(-0.3, 0.3) * half_x, -2 * storey - 1.4, 0, 0.4 * half_x, 0.5, half_z + 0.03, pane)
    for _ in range(rng.integers(5, 14)):
        bearing, distance = rng.uniform(0, 2 * np.pi), 1 + rng.uniform(0, 9)
        builder.position, builder.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        (add_tree, add_sign, add_crates, add_crates, add_fence)[rng.integers(5)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-8, -2.5, -8], [8, -1.0, 8]])
    return Layout(sunlit_scene(builder), eye_bounds, np.array([[-4, -2.0, -4], [4, -0.3, 4]]))


def facade(rng: np.random.Generator, textures: Textures) -> Layout:
    """The front of a building with recessed windows, ledges and columns, and objects in front of it."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 6.0, *GROUND_KINDS)
    wall = builder.material("brick", "cells", "plain", "noise", "wood", period=rng.uniform(0.8, 3.0))
    trim, pane = builder.material("plain", "noise", "speckle"), builder.material("plain", "gradient", "collage")
    half_x, height, depth = rng.uniform(4, 9), rng.uniform(3, 9), rng.uniform(0.05, 0.4)
    builder.box(0, -height / 2, 1.0, half_x, height / 2, 1.0, pane)
    columns, storeys = int(rng.integers(3, 8)), max(1, round(height / rng.uniform(2.2, 3.2)))
    pitch, storey = 2 * half_x / columns, height / storeys
    pier, band = rng.uniform(0.15, 0.35) * pitch, rng.uniform(0.15, 0.3) * storey
    for column in range(columns + 1):
        builder.box(-half_x + column * pitch, -height / 2, -depth / 2, pier, height / 2, depth / 2, wall)
    for level in range(storeys + 1):
        builder.box(0, -level * storey, -depth / 2, half_x, band, depth / 2 + 0.03, wall)
        builder.box(0, -level * storey - band, -depth / 2, half_x, 0.06, depth / 2 + rng.uniform(0.03, 0.2), trim)
    for _ in range(rng.integers(2, 9)):
        builder.position, builder.yaw = (
            (rng.uniform(-0.9, 0.9) * half_x, 0.0, -rng.uniform(0.6, 4.0)),
            rng.uniform(0, 7),
        )
        (add_plant, add_sign, add_crates, add_fence, add_tree)[rng.integers(5)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-0.6 * half_x, -2.2, -9.0], [0.6 * half_x, -1.2, -3.5]])
    focus_bounds = np.array([[-0.5 * half_x, -0.6 * height, 0.0], [0.5 * half_x, -0.8, 0.0]])
    return Layout(sunlit_scene(builder), eye_bounds, focus_bounds)


def around_object(rng: np.random.Generator, textures: Textures) -> Layout:
    """One object of intersecting solids, some cut or free-form, on the ground or on a stand, seen from nearby."""
    builder = SceneBuilder(rng, textures)
    outside = rng.random() < 0.5
    size = add_room(builder) if not outside else None
    if outside:
        add_ground_and_sky(builder, 1.5, *GROUND_KINDS)
    top = rng.choice([0.0, rng.uniform(0.3, 0.9)])
    if top:
        stand = builder.material(*FURNITURE_KINDS)
        builder.add(CYLINDER, (0, -top / 2, 0), (rng.uniform(0.25, 0.6), top / 2, rng.uniform(0.25, 0.6)), stand)
    scale = rng.uniform(0.12, 0.4)
    materials = [builder.material(*ANY_KINDS, period=scale * rng.uniform(0.5, 3.0)) for _ in range(rng.integers(1, 5))]
    for _ in range(rng.integers(5, 24)):
        half = scale * np.exp(rng.normal(-0.9, 0.5, 3))
        centre = tuple(rng.normal(0, 0.5, 3) * scale - (0, top + scale, 0))
        _add_part(builder, centre, tuple(half), materials[rng.integers(len(materials))])
    for _ in range(rng.integers(0, 5)):
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 2.5)
        builder.position, builder.yaw = (distance * np.cos(bearing), 0, distance * np.sin(bearing)), rng.uniform(0, 7)
        (add_plant, add_crates, add_chair)[rng.integers(3)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    bearing, distance = rng.uniform(0, 2 * np.pi), scale * rng.uniform(2.5, 5.0)
    eye = np.array([distance * np.cos(bearing), -top - scale * rng.uniform(0.5, 3.0), distance * np.sin(bearing)])
    focus = np.array([0.0, -top - scale, 0.0])
    spread = 0.3 * scale
    scene = sunlit_scene(builder) if size is None else lamplit_scene(builder, *size)
    return Layout(scene, np.stack([eye - spread, eye + spread]), np.stack([focus - spread, focus + spread]))


def _add_part(
    builder: SceneBuilder, centre: tuple[float, float, float], half: tuple[float, float, float], material: int
) -> None:
    """Add a randomly turned solid that is plain, free-form, notched or bored."""
    rng = builder.rng
    turn = random_rotation(rng)
    if rng.random() < 0.3:
        squareness, bumps = rng.uniform(0, 1), rng.uniform(0.05, 0.35)
        builder.add(FREE_FORM, centre, half, material, turn, squareness=squareness, bumps=bumps)
        return
    shape = int(rng.choice([BOX, ELLIPSOID, ELLIPSOID, CYLINDER]))
    kind = rng.integers(4)
    if kind == 0:
        place, width = tuple(rng.uniform(-1, 1, 3)), tuple(rng.uniform(0.3, 0.8, 3))
        builder.add(shape, centre, half, material, turn, cut_out(BOX, place, width))
    elif kind == 1:
        axes, radius = np.eye(3)[rng.permutation(3)], rng.uniform(0.3, 0.7)
        builder.add(shape, centre, half, material, turn, cut_out(CYLINDER, (0, 0, 0), (radius, THROUGH, radius), axes))
    else:
        builder.add(shape, centre, half, material, turn)


def sculpture(rng: np.random.Generator, textures: Textures) -> Layout:
    """A free-form sculpture on a stand in the open, with stones, blocks and plants around it."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 3.0, *GROUND_KINDS)
    top, size = rng.uniform(0.2, 0.9), rng.uniform(0.25, 0.5)
    stand = builder.material(*FURNITURE_KINDS)
    width = size * rng.uniform(0.8, 1.4)
    builder.add(int(rng.choice([BOX, CYLINDER])), (0, -top / 2, 0), (width, top / 2, width), stand)
    builder.position = (0.0, -top, 0.0)
    add_sculpture(builder, size)
    _scatter_ruins(builder, int(rng.integers(3, 9)), (1.2, 4.0))
    focus = np.array([0.0, -top - size, 0.0])
    eye_bounds = np.array([[-3.0, -top - 1.8, -3.0], [3.0, -top - 0.2, 3.0]])
    return Layout(sunlit_scene(builder), eye_bounds, np.stack([focus - 0.3, focus + 0.3]))


def ruins(rng: np.random.Generator, textures: Textures) -> Layout:
    """Walls with doors, windows and arches, pipes, hollow blocks and stones in the open."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 4.0, *GROUND_KINDS)
    for _ in range(rng.integers(2, 6)):
        builder.position, builder.yaw = (rng.uniform(-4, 4), 0.0, rng.uniform(0, 6)), rng.normal(0, 0.5)
        add_wall_with_opening(builder)
    _scatter_ruins(builder, int(rng.integers(5, 12)), (1.0, 5.0))
    eye_bounds = np.array([[-4, -2.2, -7], [4, -0.8, -3]])
    return Layout(sunlit_scene(builder), eye_bounds, np.array([[-2, -1.2, 0], [2, -0.4, 3]]))


def _scatter_ruins(builder: SceneBuilder, count: int, distances: tuple[float, float]) -> None:
    """Add stones, hollow blocks, pipes and plants around the origin. distances: least and largest, in metres."""
    rng = builder.rng
    for _ in range(count):
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*distances)
        builder.position, builder.yaw = (distance * np.cos(bearing), 0.0, distance * np.sin(bearing)), rng.uniform(0, 7)
        kind = rng.integers(6)
        if kind < 2:
            add_stone(builder, rng.uniform(0.1, 0.6))
        elif kind == 2:
            add_pierced_block(builder, rng.uniform(0.15, 0.5))
        else:
            (add_pipes, add_plant, add_tree)[kind - 3](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0


def from_above(rng: np.random.Generator, textures: Textures) -> Layout:
    """Houses, trees and roads, seen from above."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 10.0, *GROUND_KINDS)
    for _ in range(rng.integers(1, 4)):
        builder.yaw = rng.uniform(0, np.pi)
        road = builder.material("plain", "noise", "speckle", period=3.0)
        builder.box(rng.uniform(-6, 6), -0.01, 0, rng.uniform(0.8, 2.0), 0.02, 17, road)
    for _ in range(rng.integers(6, 22)):
        builder.position, builder.yaw = (rng.uniform(-12, 12), 0.0, rng.uniform(-12, 12)), rng.uniform(0, 7)
        half_x, half_y, half_z = rng.uniform(0.8, 2.5), rng.uniform(0.6, 2.5), rng.uniform(0.8, 2.5)
        wall, roof = (
            builder.material(*WALL_KINDS, period=2.0),
            builder.material("brick", "stripes", "cells", period=1.5),
        )
        builder.box(0, -half_y, 0, half_x, half_y, half_z, wall)
        slope = rng.uniform(0.2, 0.7)
        cos, sin = np.cos(slope), np.sin(slope)
        for side in (-1, 1):
            axes = np.array([[cos, side * sin, 0], [-side * sin, cos, 0], [0, 0, 1.0]])
            centre = (side * 0.5 * half_x, -2 * half_y - 0.5 * half_x * np.tan(slope), 0)
            builder.add(BOX, centre, (0.55 * half_x / cos, 0.04, 1.1 * half_z), roof, axes)
    for _ in range(rng.integers(4, 16)):
        builder.position, builder.yaw = (rng.uniform(-12, 12), 0.0, rng.uniform(-12, 12)), 0.0
        add_tree(builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-10, -14.0, -10], [10, -7.0, 10]])
    return Layout(sunlit_scene(builder), eye_bounds, np.array([[-4, -1.0, -4], [4, 0.0, 4]]))


def foliage(rng: np.random.Generator, textures: Textures) -> Layout:
    """Bushes of many thin leaves at many depths, in front of a wall or open ground."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 2.5, "strokes", "noise", "cells")
    if rng.random() < 0.5:
        builder.box(0, -1.5, 2.5, 5, 1.5, 0.1, builder.material(*WALL_KINDS, period=2.0))
    for _ in range(rng.integers(2, 5)):
        leaf = builder.material("strokes", "noise", "gradient", period=rng.uniform(0.1, 0.4))
        wood = builder.material("wood", "noise", period=0.3)
        position, radius = (rng.uniform(-1.5, 1.5), 0.0, rng.uniform(-0.5, 2.0)), rng.uniform(0.3, 0.7)
        builder.position, length = position, rng.uniform(0.05, 0.16)
        for _ in range(rng.integers(2, 6)):
            half = rng.uniform(0.4, 0.8) * radius
            tilt = random_rotation(rng, 0.6)
            builder.add(CYLINDER, (rng.normal(0, 0.1), -half, rng.normal(0, 0.1)), (0.015, half, 0.015), wood, tilt)
        for _ in range(rng.integers(15, 40)):
            centre = tuple(rng.normal(0, 0.5, 3) * radius - (0, radius, 0))
            blade = length * rng.uniform(0.3, 0.6), length, 0.04 * length
            builder.add(ELLIPSOID, centre, blade, leaf, random_rotation(rng))
    builder.position = (0.0, 0.0, 0.0)
    eye_bounds = np.array([[-1.5, -1.7, -3.5], [1.5, -0.5, -1.8]])
    return Layout(sunlit_scene(builder), eye_bounds, np.array([[-0.8, -0.9, 0.0], [0.8, -0.3, 1.0]]))


def hills(rng: np.random.Generator, textures: Textures) -> Layout:
    """Uneven ground with rocks, trees and fences, under the sky."""
    builder = SceneBuilder(rng, textures)
    add_ground_and_sky(builder, 6.0, *GROUND_KINDS)
    rise = np.exp(rng.uniform(np.log(0.1), np.log(1.5)))
    ground = builder.material("strokes", "noise", "cells", "speckle", period=rng.uniform(0.8, 4.0))
    builder.add(HEIGHT_FIELD, (0, -rise, 0), (9.0, rise, 9.0), ground)
    rock = builder.material("noise", "speckle", "cells", period=rng.uniform(0.3, 1.5))
    for _ in range(rng.integers(3, 14)):
        size = rng.uniform(0.1, 0.7)
        centre = (rng.uniform(-4, 4), -1.2 * rise, rng.uniform(-4, 4))
        half, turn, bumps = tuple(size * np.exp(rng.normal(0, 0.4, 3))), random_rotation(rng), rng.uniform(0.05, 0.3)
        builder.add(FREE_FORM, centre, half, rock, turn, squareness=rng.uniform(0, 1), bumps=bumps)
    for _ in range(rng.integers(1, 7)):
        builder.position = (rng.uniform(-5, 5), -rise, rng.uniform(-3, 6))
        builder.yaw = rng.uniform(0, 2 * np.pi)
        (add_tree, add_fence, add_sign, add_crates, add_plant)[rng.integers(5)](builder)
    builder.position, builder.yaw = (0.0, 0.0, 0.0), 0.0
    eye_bounds = np.array([[-4, -2 * rise - 2.5, -7], [4, -2 * rise - 0.6, -3]])
    return Layout(sunlit_scene(builder), eye_bounds, np.array([[-2, -rise - 1.0, -1], [2, -rise, 3]]))
