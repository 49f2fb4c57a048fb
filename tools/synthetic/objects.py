"""Objects of synthetic scenes: furniture, plants, boxes, street furniture. Each is added in the builder's frame."""

import numpy as np

from .builder import ANY_KINDS, FURNITURE_KINDS, POSTER_KINDS, SceneBuilder, random_rotation
from .raycast import BOX, CYLINDER, ELLIPSOID


def furnish_wall(builder: SceneBuilder, wall: int, width: float, height: float, length: float) -> None:
    """Add furniture and framed posters along one of the four walls."""
    rng = builder.rng
    along, away = (width, length / 2) if wall % 2 == 0 else (length, width / 2)
    turn = wall * np.pi / 2

    def move_to(offset: float, distance: float) -> None:
        """Move the builder's frame to the wall: x along it, z out of it."""
        builder.yaw = turn
        cos, sin = np.cos(turn), np.sin(turn)
        x, z = offset, distance - away
        builder.position = (x * cos + z * sin, 0.0, -x * sin + z * cos)

    move_to(rng.uniform(-0.25, 0.25) * along, 0.0)
    (_add_shelf, _add_sofa, _add_cabinet, _add_window, _add_window, add_crates)[rng.integers(6)](builder)
    for _ in range(rng.integers(1, 3)):
        move_to(rng.uniform(-0.42, 0.42) * along, 0.0)
        half_x, half_y = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.45)
        y = -min(rng.uniform(1.5, 1.9), height - half_y - 0.1)
        builder.box(0, y, 0, half_x, half_y, 0.03, builder.material("wood", "plain"))
        poster = builder.material(*POSTER_KINDS, period=2 * max(half_x, half_y))
        builder.box(0, y, 0, 0.9 * half_x, 0.88 * half_y, 0.035, poster)
    if rng.random() < 0.5:
        move_to(rng.choice([-0.43, 0.43]) * along, 0.4)
        (add_plant, add_lamp)[rng.integers(2)](builder)


def add_table(builder: SceneBuilder, height: float) -> None:
    """Add a table with small objects on it."""
    rng = builder.rng
    wood = builder.material(*FURNITURE_KINDS)
    half_x, half_z = rng.uniform(0.4, 0.95), rng.uniform(0.3, 0.55)
    builder.box(0, -height + 0.02, 0, half_x, 0.02, half_z, wood)
    leg = rng.uniform(0.02, 0.045)
    for side_x in (-1, 1):
        for side_z in (-1, 1):
            x, z = side_x * (half_x - 2 * leg), side_z * (half_z - 2 * leg)
            builder.box(x, -height / 2 + 0.02, z, leg, height / 2 - 0.02, leg, wood)
    position, yaw = builder.position, builder.yaw
    cos, sin = np.cos(yaw), np.sin(yaw)
    for _ in range(rng.integers(1, 5)):
        x, z = rng.uniform(-0.8, 0.8) * half_x, rng.uniform(-0.8, 0.8) * half_z
        builder.position = (position[0] + x * cos + z * sin, -height, position[2] - x * sin + z * cos)
        builder.yaw = rng.uniform(0, 2 * np.pi)
        add_small_object(builder, rng.uniform(0.06, 0.16))
    builder.position, builder.yaw = position, yaw


def add_small_object(builder: SceneBuilder, size: float) -> None:
    """Add a book, ball, can, vase or card; the builder's position is on the surface that it stands on."""
    rng = builder.rng
    material = builder.material(*ANY_KINDS, period=size * rng.uniform(1.5, 4))
    y = builder.position[1]
    builder.position = (builder.position[0], 0.0, builder.position[2])
    kind = rng.integers(5)
    if kind == 0:
        thickness = 0.3 * size
        builder.box(0, y - thickness, 0, size, thickness, 0.7 * size, material)
    elif kind == 1:
        builder.add(ELLIPSOID, (0, y - 0.9 * size, 0), (size, 0.9 * size, size), material)
    elif kind == 2:
        builder.add(CYLINDER, (0, y - size, 0), (0.55 * size, size, 0.55 * size), material)
    elif kind == 3:
        builder.add(ELLIPSOID, (0, y - 0.8 * size, 0), (0.7 * size, 0.8 * size, 0.7 * size), material)
        builder.add(CYLINDER, (0, y - 1.8 * size, 0), (0.2 * size, 0.5 * size, 0.2 * size), material)
    else:
        builder.box(0, y - size, 0, 0.8 * size, size, 0.03 * size, material)


def add_bowl(builder: SceneBuilder, size: float) -> None:
    """Add a bowl, a half ball that is hollow, often with a fruit in it. size: its radius in metres."""
    rng = builder.rng
    material, height = builder.material(*ANY_KINDS, period=size * rng.uniform(0.7, 3.0)), size * rng.uniform(0.4, 0.9)
    # In the unit frame, y = 1 is the foot: a ball about the middle of the open side leaves a wall and a floor.
    builder.add(CYLINDER, (0, -height, 0), (size, height, size), material, cut=(0.0, -1.0, 0.0, rng.uniform(0.9, 0.97)))
    if rng.random() < 0.6:
        fruit = builder.material("plain", "noise", "speckle", "gradient", period=size)
        builder.add(ELLIPSOID, (0, -1.2 * height, 0), tuple(0.5 * size * np.exp(rng.normal(0, 0.2, 3))), fruit)


def add_cup(builder: SceneBuilder, size: float) -> None:
    """Add a cup, or a box that is hollow. size: about its height in metres."""
    rng = builder.rng
    material, width = builder.material(*ANY_KINDS, period=size * rng.uniform(0.7, 3.0)), size * rng.uniform(0.3, 0.6)
    shape = int(rng.choice([CYLINDER, CYLINDER, BOX]))
    cut = (0.0, -1.0, 0.0, rng.uniform(0.85, 0.95))
    builder.add(shape, (0, -size / 2, 0), (width, size / 2, width), material, cut=cut)
    if rng.random() < 0.5:  # a handle, or a pen
        builder.add(BOX, (width, -size / 2, 0), (0.3 * width, 0.3 * size, 0.08 * width), material)


def add_chair(builder: SceneBuilder) -> None:
    """Add a chair with a back."""
    material = builder.material(*FURNITURE_KINDS)
    builder.box(0, -0.45, 0, 0.22, 0.025, 0.22, builder.material(*FURNITURE_KINDS))
    for x in (-0.19, 0.19):
        builder.box(x, -0.22, 0.19, 0.02, 0.22, 0.02, material)
        builder.box(x, -0.48, -0.2, 0.02, 0.48, 0.02, material)
    builder.box(0, -0.8, -0.2, 0.2, 0.12, 0.015, material)


def _add_sofa(builder: SceneBuilder) -> None:
    rng = builder.rng
    cloth = builder.material("weave", "noise", "plain", "stripes", "strokes", period=rng.uniform(0.3, 1.0))
    half = rng.uniform(0.7, 1.1)
    builder.box(0, -0.21, 0.45, half, 0.21, 0.42, cloth)
    builder.box(0, -0.45, 0.14, half, 0.4, 0.12, cloth)
    for x in (-half, half):
        builder.box(x, -0.31, 0.45, 0.1, 0.31, 0.44, cloth)
    for _ in range(rng.integers(1, 4)):
        cushion = builder.material(*POSTER_KINDS, "stripes", "checker", period=0.5)
        centre = (rng.uniform(-0.7, 0.7) * half, -0.6, 0.33)
        builder.add(ELLIPSOID, centre, (0.24, 0.22, 0.1), cushion, random_rotation(rng, 0.2))


def _add_shelf(builder: SceneBuilder) -> None:
    """Add a bookcase with books."""
    rng = builder.rng
    wood = builder.material("wood", "plain", period=1.0)
    half, boards, gap = rng.uniform(0.4, 0.8), int(rng.integers(3, 6)), rng.uniform(0.3, 0.4)
    books = [builder.material(*ANY_KINDS, period=rng.uniform(0.1, 0.5)) for _ in range(4)]
    for x in (-half, half):
        builder.box(x, -boards * gap / 2, 0.16, 0.015, boards * gap / 2, 0.16, wood)
    builder.box(0, -boards * gap / 2, 0.01, half, boards * gap / 2, 0.01, builder.material("plain", "wood"))
    for board in range(boards):
        y = -(board + 1) * gap
        builder.box(0, y, 0.16, half, 0.012, 0.16, wood)
        x = -half + 0.03
        while x < half * rng.uniform(0.1, 1.0) and len(builder.solids) < 80:
            thickness, tall = rng.uniform(0.02, 0.09), rng.uniform(0.5, 0.85) * gap / 2
            builder.box(x + thickness, y + gap - 0.012 - tall, 0.17, thickness, tall, 0.11, books[rng.integers(4)])
            x += 2 * thickness + rng.choice([0.003, 0.003, 0.08])


def _add_cabinet(builder: SceneBuilder) -> None:
    rng = builder.rng
    half_x, half_y = rng.uniform(0.4, 0.9), rng.uniform(0.35, 0.6)
    builder.box(0, -half_y, 0.23, half_x, half_y, 0.22, builder.material(*FURNITURE_KINDS))
    door = builder.material(*FURNITURE_KINDS)
    for x in (-half_x / 2, half_x / 2):
        builder.box(x, -half_y, 0.46, 0.46 * half_x, 0.9 * half_y, 0.012, door)
    height = 2 * half_y
    x, _, z = builder.position
    cos, sin = np.cos(builder.yaw), np.sin(builder.yaw)
    for offset in rng.uniform(-0.8, 0.8, rng.integers(1, 4)) * half_x:
        builder.position = (x + offset * cos + 0.23 * sin, -height, z - offset * sin + 0.23 * cos)
        add_small_object(builder, rng.uniform(0.06, 0.16))


def _add_window(builder: SceneBuilder) -> None:
    rng = builder.rng
    view = builder.material("gradient", "noise", "plain", period=3.0, emission=rng.uniform(0.2, 0.5))
    frame = builder.material("plain", "wood")
    half_x, half_y = rng.uniform(0.4, 0.8), rng.uniform(0.45, 0.65)
    builder.box(0, -1.45, 0, half_x, half_y, 0.02, view)
    for x in (-half_x, 0, half_x):
        builder.box(x, -1.45, 0.02, 0.03, half_y, 0.03, frame)
    for y in (-1.45 - half_y, -1.45 + half_y):
        builder.box(0, y, 0.02, half_x + 0.03, 0.03, 0.03 + 0.05 * (y > -1.45), frame)
    curtain = builder.material("stripes", "weave", "noise", "plain", period=0.6)
    for side in (-1, 1):
        builder.box(side * (half_x + 0.2), -1.35, 0.05, 0.18, 0.85, 0.02, curtain)


def add_lamp(builder: SceneBuilder) -> None:
    """Add a floor lamp with an emissive shade, which is no light source."""
    height = builder.rng.uniform(1.2, 1.7)
    stand = builder.material("plain", "noise")
    builder.add(CYLINDER, (0, -0.015, 0), (0.15, 0.015, 0.15), stand)
    builder.add(CYLINDER, (0, -height / 2, 0), (0.014, height / 2, 0.014), stand)
    shade = builder.material("plain", "weave", "stripes", emission=0.6)
    builder.add(CYLINDER, (0, -height, 0), (0.2, 0.16, 0.2), shade)


def add_plant(builder: SceneBuilder) -> None:
    """Add a potted plant."""
    rng = builder.rng
    builder.add(CYLINDER, (0, -0.15, 0), (0.14, 0.15, 0.14), builder.material("plain", "stripes", "checker", "cells"))
    leaf = builder.material("strokes", "noise", period=0.3)
    for _ in range(rng.integers(4, 9)):
        centre = (rng.normal(0, 0.12), -rng.uniform(0.4, 1.0), rng.normal(0, 0.12))
        builder.add(ELLIPSOID, centre, (0.07, 0.25, 0.02), leaf, random_rotation(rng, 0.6))


def add_crates(builder: SceneBuilder) -> None:
    """Add a stack of boxes or drums."""
    rng = builder.rng
    top, size = 0.0, rng.uniform(0.15, 0.4)
    for _ in range(rng.integers(1, 4)):
        half_y = size * rng.uniform(0.5, 1.0)
        shape = int(rng.choice([BOX, BOX, CYLINDER]))
        axes = np.eye(3)
        angle = rng.normal(0, 0.3)
        axes[0, 0], axes[0, 2], axes[2, 0], axes[2, 2] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        material = builder.material(*ANY_KINDS, period=2 * size)
        builder.add(shape, (0, -top - half_y, 0.45), (size, half_y, size), material, axes)
        top, size = top + 2 * half_y, size * rng.uniform(0.6, 0.95)


def add_tree(builder: SceneBuilder) -> None:
    """Add a tree: a trunk and ellipsoids of foliage."""
    rng = builder.rng
    height = rng.uniform(1.5, 4)
    builder.add(CYLINDER, (0, -height / 2, 0), (0.15, height / 2, 0.15), builder.material("wood", "noise", period=0.8))
    leaves = builder.material("strokes", "noise", "cells", period=rng.uniform(0.6, 2))
    for _ in range(rng.integers(2, 6)):
        centre = (rng.normal(0, 0.6), -height - rng.uniform(-0.3, 1), rng.normal(0, 0.6))
        builder.add(ELLIPSOID, centre, tuple(rng.uniform(0.5, 1.3, 3)), leaves, random_rotation(rng))


def add_sign(builder: SceneBuilder) -> None:
    """Add a pole with a sign."""
    rng = builder.rng
    height = rng.uniform(1.5, 4)
    builder.add(CYLINDER, (0, -height / 2, 0), (0.05, height / 2, 0.05), builder.material("plain", "stripes"))
    sign = builder.material(*POSTER_KINDS, period=1.0)
    builder.box(0, -height, 0, rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.5), 0.06, sign)


def add_fence(builder: SceneBuilder) -> None:
    """Add a piece of fence."""
    material = builder.material("wood", "plain")
    for x in np.arange(-1.2, 1.21, 0.4):
        builder.box(x, -0.5, 0, 0.05, 0.5, 0.02, material)
    for y in (-0.3, -0.8):
        builder.box(0, y, 0.03, 1.3, 0.04, 0.015, material)
