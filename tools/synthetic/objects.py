"""Objects of synthetic scenes: furniture, plants, boxes, street furniture. Each is added in the builder's frame."""

import numpy as np

from .builder import (
    ANY_KINDS,
    FURNITURE_KINDS,
    NO_CUT,
    POSTER_KINDS,
    WALL_KINDS,
    Cut,
    SceneBuilder,
    cut_out,
    random_rotation,
)
from .raycast import BOX, CYLINDER, ELLIPSOID, FREE_FORM

# Rows: axes of a solid of which y, the axis of a cylinder, lies along the x or z of the builder's frame.
ALONG_X = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
ALONG_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
WINDOW_HEIGHT = -1.45  # y of the middle of a window, in metres
WINDOW_LIGHT_GAP = 0.25  # from a wall to the light of its window, in metres: in front of frame and curtains
THROUGH = 1.5  # half length of a cut in the unit frame that passes through a solid


def furnish_wall(builder: SceneBuilder, wall: int, width: float, height: float, length: float) -> None:
    """Add furniture and framed posters along one of the four walls."""
    rng = builder.rng
    along = width if wall % 2 == 0 else length

    def move_to(offset: float, distance: float) -> None:
        _move_to_wall(builder, wall, width, length, offset, distance)

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


def _move_to_wall(
    builder: SceneBuilder, wall: int, width: float, length: float, offset: float, distance: float
) -> None:
    """Move the builder's frame to one of the four walls of a room: x along it, z out of it. All lengths are metres."""
    turn = wall * np.pi / 2
    builder.yaw = turn
    cos, sin = np.cos(turn), np.sin(turn)
    x, z = offset, distance - (length / 2 if wall % 2 == 0 else width / 2)
    builder.position = (x * cos + z * sin, 0.0, -x * sin + z * cos)


def add_bright_windows(builder: SceneBuilder, wall: int, width: float, length: float) -> list[np.ndarray]:
    """Add one or two windows through which daylight comes; returns the world positions of lights in front of them.

    width, length: of the room in metres.
    """
    rng = builder.rng
    along = width if wall % 2 == 0 else length
    places = [-0.27, 0.27] if rng.random() < 0.5 else [rng.uniform(-0.2, 0.2)]
    lights = []
    for place in places:
        _move_to_wall(builder, wall, width, length, place * along, 0.0)
        _add_window(builder, glare=rng.uniform(0.8, 1.6))
        _move_to_wall(builder, wall, width, length, place * along, WINDOW_LIGHT_GAP)
        lights.append(np.add(builder.position, (0.0, WINDOW_HEIGHT, 0.0)))
    return lights


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
    builder.add(CYLINDER, (0, -height, 0), (size, height, size), material, cut=_ball(rng.uniform(0.9, 0.97)))
    if rng.random() < 0.6:
        fruit = builder.material("plain", "noise", "speckle", "gradient", period=size)
        builder.add(ELLIPSOID, (0, -1.2 * height, 0), tuple(0.5 * size * np.exp(rng.normal(0, 0.2, 3))), fruit)


def _ball(radius: float) -> Cut:
    """A ball about the middle of the upper side."""
    return cut_out(ELLIPSOID, (0.0, -1.0, 0.0), (radius, radius, radius))


def add_cup(builder: SceneBuilder, size: float) -> None:
    """Add a cup, or a box that is hollow. size: about its height in metres."""
    rng = builder.rng
    material, width = builder.material(*ANY_KINDS, period=size * rng.uniform(0.7, 3.0)), size * rng.uniform(0.3, 0.6)
    shape = int(rng.choice([CYLINDER, CYLINDER, BOX]))
    cut = _ball(rng.uniform(0.85, 0.95))
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


def _add_window(builder: SceneBuilder, glare: float | None = None) -> None:
    """Add a window with curtains. glare: light that the pane emits, by default random and faint."""
    rng = builder.rng
    emission = rng.uniform(0.2, 0.5) if glare is None else glare
    view = builder.material("gradient", "noise", "plain", period=3.0, emission=emission)
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


def add_stone(builder: SceneBuilder, size: float) -> None:
    """Add a stone or, on a table, a fruit or loaf: a bumpy ball, partly sunk. size: about its half extent in metres."""
    rng = builder.rng
    stone = builder.material("noise", "speckle", "cells", "plain", period=size * rng.uniform(0.7, 3.0))
    half = size * np.exp(rng.normal(0, 0.25, 3))
    squareness, bumps = rng.uniform(0, 0.6), rng.uniform(0.05, 0.25)
    centre = (0, -0.6 * half[1], 0)
    builder.add(FREE_FORM, centre, tuple(half), stone, random_rotation(rng, 0.3), NO_CUT, squareness, bumps)


def add_cushion(builder: SceneBuilder, size: float) -> None:
    """Add a cushion or a bag, which lies or stands: a creased rounded box. size: its half width in metres."""
    rng = builder.rng
    cloth = builder.material(*POSTER_KINDS, "stripes", "checker", "plain", period=size * rng.uniform(0.7, 3.0))
    half = size * np.array([1.0, rng.uniform(0.3, 0.5), rng.uniform(0.7, 1.2)])
    tilt = random_rotation(rng, 0.1)
    if rng.random() < 0.4:
        half, tilt = half[[0, 2, 1]], random_rotation(rng, 0.2)
    squareness, bumps = rng.uniform(0.6, 1.0), rng.uniform(0.03, 0.12)
    builder.add(FREE_FORM, (0, -0.85 * half[1], 0), tuple(half), cloth, tilt, NO_CUT, squareness, bumps)


def add_sculpture(builder: SceneBuilder, size: float) -> None:
    """Add a sculpture of one to three free-form solids, one upon the other. size: half its width in metres."""
    rng = builder.rng
    materials = [builder.material(*ANY_KINDS, period=size * rng.uniform(0.5, 3.0)) for _ in range(2)]
    top = 0.0
    for _ in range(rng.integers(1, 4)):
        half = size * np.exp(rng.normal(0, 0.25, 3))
        squareness, bumps = rng.uniform(0, 1), rng.uniform(0.05, 0.35)
        centre, turn = (0, -top - 0.8 * half[1], 0), random_rotation(rng, 0.4)
        material = materials[rng.integers(2)]
        builder.add(FREE_FORM, centre, tuple(half), material, turn, NO_CUT, squareness, bumps)
        top, size = top + 1.5 * half[1], 0.8 * size


def add_pierced_block(builder: SceneBuilder, size: float) -> None:
    """Add a crate with a niche, an open box, a bored block or a short pipe. size: its half width in metres."""
    rng = builder.rng
    material = builder.material(*ANY_KINDS, period=size * rng.uniform(0.7, 3.0))
    half = size * np.array([1.0, rng.uniform(0.5, 1.2), rng.uniform(0.5, 1.0)])
    kind, wall = rng.integers(4), rng.uniform(0.75, 0.92)
    shape, axes = BOX, None
    if kind == 0:
        cut = cut_out(BOX, (0, 0, -0.5), (wall, wall, 1.2))
    elif kind == 1:
        cut = cut_out(BOX, (0, -0.3, 0), (wall, 1.15, wall))
    elif kind == 2:
        bore = rng.uniform(0.3, 0.8, 3)
        cut = cut_out(CYLINDER, (0, rng.uniform(-0.2, 0.2), 0), (bore[0], THROUGH, bore[1]), ALONG_Z)
    else:
        shape, cut = CYLINDER, cut_out(CYLINDER, (0, 0, 0), (wall, THROUGH, wall))
        if rng.random() < 0.5:  # it lies
            axes, half = ALONG_X, half[[1, 0, 2]]
    height = half[1] if axes is None else half[0]
    builder.add(shape, (0, -height, 0), tuple(half), material, axes, cut)


def add_wall_with_opening(builder: SceneBuilder) -> None:
    """Add a piece of wall with a door, a window, a round hole or an arch; it is along x."""
    rng = builder.rng
    material = builder.material(*WALL_KINDS, "brick", period=rng.uniform(0.8, 3.0))
    half = np.array([rng.uniform(0.8, 2.0), rng.uniform(1.0, 1.6), rng.uniform(0.08, 0.4)])
    kind, wide, place = rng.integers(4), rng.uniform(0.3, 0.6), rng.uniform(-0.3, 0.3)
    if kind == 3:
        _add_arch(builder, half, wide, material)
        return
    if kind == 0:
        cut = cut_out(BOX, (place, 0.3, 0), (0.7 * wide, rng.uniform(0.8, 1.1), THROUGH))
    elif kind == 1:
        cut = cut_out(BOX, (place, rng.uniform(-0.3, 0.1), 0), (wide, rng.uniform(0.2, 0.5), THROUGH))
    else:
        radius = 0.8 * min(half[0], half[1])
        cut = cut_out(CYLINDER, (0, 0, 0), (radius / half[0], THROUGH, radius / half[1]), ALONG_Z)
    builder.add(BOX, (0, -half[1], 0), tuple(half), material, None, cut)


def _add_arch(builder: SceneBuilder, half: np.ndarray, wide: float, material: int) -> None:
    """Add a wall of half extents `half` in metres with a round arch.

    wide: half width of the arch relative to that of the wall.
    """
    rise = min(wide * half[0] / (2 * half[1]), 0.8)  # of the round part, relative to the wall's height
    spring = 2 * half[1] * (1 - rise) * builder.rng.uniform(0.6, 0.95)  # height at which the arch begins
    pier, upper = 0.5 * half[0] * (1 - wide), half[1] - spring / 2
    for side in (-1, 1):
        builder.box(side * (half[0] - pier), -spring / 2, 0, pier, spring / 2, half[2], material)
    radius = min(wide * half[0] / upper, 1.8)
    cut = cut_out(CYLINDER, (0, 1, 0), (wide, THROUGH, radius), ALONG_Z)
    builder.add(BOX, (0, -spring - upper, 0), (half[0], upper, half[2]), material, None, cut)


def add_pipes(builder: SceneBuilder) -> None:
    """Add a stack of one to three wide pipes that lie on the ground."""
    rng = builder.rng
    material = builder.material("plain", "noise", "speckle", "stripes", period=rng.uniform(0.5, 2.0))
    radius, half_length, wall = rng.uniform(0.2, 0.6), rng.uniform(0.5, 1.8), rng.uniform(0.8, 0.93)
    cut = cut_out(CYLINDER, (0, 0, 0), (wall, THROUGH, wall))
    for x, y in ((-1, 1), (1, 1), (0, 1 + 3**0.5))[: rng.integers(1, 4)]:
        builder.add(CYLINDER, (x * radius, -y * radius, 0), (radius, half_length, radius), material, ALONG_Z, cut)
