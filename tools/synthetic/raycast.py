"""A compiled ray caster: exact z-depth and antialiased colour of boxes, ellipsoids, cylinders and wavy solids.

Ray directions have z = 1 in the camera frame, so that the ray parameter is the z-depth. Each solid is a unit cube,
ball, cylinder, height field or free-form solid in its own frame, scaled by `halves`, less the solid of `cuts`. For each
tile of the image only the solids whose bounding rectangle overlaps it are intersected, nearest first.

Intersection and shading are in one module, since numba's cache does not notice changes in the modules that are inlined.
"""

import functools

import numpy as np

from ...runtime.system.compilation import compiled
from .scene import WAVES, Scene
from .textures import LEVELS, SIZE

# The cylinder's axis is its local y. A height field is the part of the cube below a surface of waves; a free-form solid
# is between a ball and a rounded cube, with waves on its surface. The last two cannot be cut.
BOX, ELLIPSOID, CYLINDER, HEIGHT_FIELD, FREE_FORM = 0, 1, 2, 3, 4
UNCUT = -1  # in `Scene.cut_shapes`
# A material that emits at least this much is lit by nothing else: a far sky, and some panes of bright windows.
LUMINOUS = 1.0
# The face of all of a sky, an enclosing ellipsoid: its texture coordinates are x and y, which have no seam.
SKY_FACE = 4
# Steps in which the surface of a height field is searched along a ray, and halvings of the step in which it is found.
MARCH_STEPS, BISECTIONS = 32, 26
# Least step in the unit frame in which the surface of a free-form solid is searched; shorter chords may be missed.
LEAST_STEP = 0.01
TILE = 8  # pixels
ON_SURFACE = 1e-9  # largest distance from a surface of a point on it, in the unit frame
NEAR = 1e-3  # metres; nearer hits are the surface from which the ray starts
LAMP_SAMPLES = 6  # shadow rays to points along a lamp
# Beyond FAR_LIGHT metres a light is a sun in front of a far sky. Its shadow rays end after SHADOW_REACH metres, since
# `_unit_hit` leaves out the first NEAR of a segment, which would be metres of one that reaches the sun.
FAR_LIGHT, SHADOW_REACH = 300.0, 60.0
# Ambient occlusion in the corners of the enclosing solid: its range in metres, and its strength.
CORNER_RANGE, CORNER_STRENGTH = 0.35, 0.35

# fastmath without `nnan` and `ninf`, since rays parallel to a face divide by zero. The loops allocate nothing: without
# numba's reference counting (`_nrt`) of the scene's arrays at every pixel they are 1.4 times as fast.
_compiled = functools.partial(compiled, fastmath={"contract", "arcp", "nsz"}, _nrt=False)
_inlined = functools.partial(_compiled, forceinline=True)


def cast_rays(
    scene: Scene,
    texels: np.ndarray,
    camera_to_world: np.ndarray,
    camera: tuple[float, float, float, float],
    offsets: np.ndarray,
    image: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Fill `depth` [H, W] with the z-depth at pixel centres and `image` [H, W, 3] with colour, in which 1 is white.

    texels: `Textures.texels`. camera_to_world: [4, 4], OpenCV axes. camera: focal lengths and
    centre in pixels, (fx, fy, cx, cy).
    offsets: the colour samples' positions inside a pixel, [samples, 2] in [0, 1); with none, `image` is unchanged.
    """
    count = len(scene.shapes)
    origins, directions = np.empty((count, 3)), np.empty((count, 3, 3))
    nearest, outlines = np.empty(count), np.empty((count, 4))
    _prepare_solids(scene, camera_to_world, camera, origins, directions, nearest, outlines)
    order, scratch = np.argsort(nearest), np.empty(count, np.int64)
    _cast(
        scene,
        texels,
        camera_to_world,
        camera,
        origins,
        directions,
        nearest,
        outlines,
        order,
        scratch,
        offsets,
        image,
        depth,
    )


@_compiled()
def _prepare_solids(
    scene: Scene,
    camera_to_world: np.ndarray,
    camera: tuple[float, float, float, float],
    origins: np.ndarray,
    directions: np.ndarray,
    nearest: np.ndarray,
    outlines: np.ndarray,
) -> None:
    """Fill the arrays that `_first_hit` reads.

    origins, directions: the camera's centre [solids, 3] and axes [solids, 3, 3] in the frames of the unit solids.
    nearest: lower bound of a solid's z-depth, [solids]. outlines: its bounding rectangle in pixels, (x0, y0, x1, y1),
    [solids, 4].
    """
    focal_x, focal_y, centre_x, centre_y = camera
    for solid in range(len(scene.shapes)):
        for i in range(3):
            origins[solid, i] = 0.0
            for k in range(3):
                axis = scene.axes[solid, i, k] / scene.halves[solid, i]
                origins[solid, i] += axis * (camera_to_world[k, 3] - scene.centres[solid, k])
            for j in range(3):
                directions[solid, i, j] = (
                    _along(scene.axes, solid, i, camera_to_world[0, j], camera_to_world[1, j], camera_to_world[2, j])
                    / scene.halves[solid, i]
                )
        least, x0, y0, x1, y1 = np.inf, np.inf, np.inf, -np.inf, -np.inf
        for corner in range(8):
            x, y, z = 0.0, 0.0, 0.0  # the corner in the camera's frame
            for k in range(3):
                place = scene.centres[solid, k] - camera_to_world[k, 3]
                for i in range(3):
                    side = 1.0 if (corner >> i) & 1 else -1.0
                    place += side * scene.halves[solid, i] * scene.axes[solid, i, k]
                x += camera_to_world[k, 0] * place
                y += camera_to_world[k, 1] * place
                z += camera_to_world[k, 2] * place
            least = min(least, max(z, 0.0))
            if z > NEAR:
                u, v = focal_x * x / z + centre_x, focal_y * y / z + centre_y
                x0, y0, x1, y1 = min(x0, u), min(y0, v), max(x1, u), max(y1, v)
        if least <= NEAR and x0 < np.inf:  # partly behind the camera: may cover any pixel
            x0, y0, x1, y1 = -np.inf, -np.inf, np.inf, np.inf
        nearest[solid] = least
        outlines[solid, 0], outlines[solid, 1], outlines[solid, 2], outlines[solid, 3] = x0, y0, x1, y1


@_compiled()
def _cast(
    scene: Scene,
    texels: np.ndarray,
    camera_to_world: np.ndarray,
    camera: tuple[float, float, float, float],
    origins: np.ndarray,
    directions: np.ndarray,
    nearest: np.ndarray,
    outlines: np.ndarray,
    order: np.ndarray,
    solids: np.ndarray,
    offsets: np.ndarray,
    image: np.ndarray,
    depth: np.ndarray,
) -> None:
    """The loop over tiles and pixels.

    order: the solids by ascending `nearest`. solids: buffer for those of a tile, [solids].
    """
    height, width = depth.shape
    focal_x, focal_y, centre_x, centre_y = camera
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            tried = 0
            for index in range(len(order)):
                solid = order[index]
                across = outlines[solid, 0] < left + TILE and outlines[solid, 2] > left
                if across and outlines[solid, 1] < top + TILE and outlines[solid, 3] > top:
                    solids[tried] = solid
                    tried += 1
            for row in range(top, min(top + TILE, height)):
                for column in range(left, min(left + TILE, width)):
                    x, y = (column + 0.5 - centre_x) / focal_x, (row + 0.5 - centre_y) / focal_y
                    _, z = _first_hit(scene, origins, directions, nearest, solids, tried, x, y)
                    depth[row, column] = z
                    if len(offsets) > 0:
                        pixel = (column - centre_x, row - centre_y, focal_x, focal_y)
                        red, green, blue = _pixel_colour(
                            scene, texels, camera_to_world, origins, directions, nearest, solids, tried, offsets, pixel
                        )
                        image[row, column, 0], image[row, column, 1], image[row, column, 2] = red, green, blue


@_inlined()
def _pixel_colour(
    scene: Scene,
    texels: np.ndarray,
    camera_to_world: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    nearest: np.ndarray,
    solids: np.ndarray,
    tried: int,
    offsets: np.ndarray,
    pixel: tuple[float, float, float, float],
) -> tuple[float, float, float]:
    """The mean colour of a pixel's samples. pixel: its corner relative to the principal point, and the focal lengths.

    Every sample looks up the texture; light is computed once for consecutive samples on the same face.
    """
    samples = len(offsets)
    red, green, blue = 0.0, 0.0, 0.0
    fine = np.log2(pixel[2] * np.sqrt(samples))  # `spread` is for a ray of width 1
    lit_solid, lit_face = -1, -1
    light_r, light_g, light_b, specular, spread, material = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for sample in range(samples):
        x, y = (pixel[0] + offsets[sample, 0]) / pixel[2], (pixel[1] + offsets[sample, 1]) / pixel[3]
        solid, z = _first_hit(scene, origins, directions, nearest, solids, tried, x, y)
        ux = origins[solid, 0] + z * (
            directions[solid, 0, 0] * x + directions[solid, 0, 1] * y + directions[solid, 0, 2]
        )
        uy = origins[solid, 1] + z * (
            directions[solid, 1, 0] * x + directions[solid, 1, 1] * y + directions[solid, 1, 2]
        )
        uz = origins[solid, 2] + z * (
            directions[solid, 2, 0] * x + directions[solid, 2, 1] * y + directions[solid, 2, 2]
        )
        face, normal_x, normal_y, normal_z = _face(scene, solid, ux, uy, uz)
        if solid != lit_solid or face != lit_face:
            lit_solid, lit_face, material = solid, face, scene.materials[solid, face]
            light_r, light_g, light_b, specular, spread = _light(
                scene, camera_to_world, solid, face, (x, y, z), (ux, uy, uz), (normal_x, normal_y, normal_z)
            )
        r, g, b = _texel(scene, texels, solid, face, material, ux, uy, uz, spread - fine + (sample + 0.5) / samples)
        red, green, blue = red + r * light_r + specular, green + g * light_g + specular, blue + b * light_b + specular
    return red / samples, green / samples, blue / samples


@_inlined()
def _first_hit(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    nearest: np.ndarray,
    solids: np.ndarray,
    tried: int,
    x: float,
    y: float,
) -> tuple[int, float]:
    """The first hit of the camera ray (x, y, 1) among the first `tried` of `solids`: the solid and its z-depth.

    solids: by ascending `nearest`.
    """
    best, best_z = 0, np.inf
    for index in range(tried):
        solid = solids[index]
        if nearest[solid] > best_z:
            break
        dx = directions[solid, 0, 0] * x + directions[solid, 0, 1] * y + directions[solid, 0, 2]
        dy = directions[solid, 1, 0] * x + directions[solid, 1, 1] * y + directions[solid, 1, 2]
        dz = directions[solid, 2, 0] * x + directions[solid, 2, 1] * y + directions[solid, 2, 2]
        z = _unit_hit(scene, solid, origins[solid, 0], origins[solid, 1], origins[solid, 2], dx, dy, dz)
        if z < best_z:
            best, best_z = solid, z
    return best, best_z


@_inlined()
def _unit_hit(scene: Scene, solid: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """The first t > NEAR at which o + t d meets the surface of a solid, in its unit frame; infinity if it does not."""
    shape = scene.shapes[solid]
    enter, leave = _interval(shape, ox, oy, oz, dx, dy, dz)
    if not (enter <= leave and leave > NEAR):
        return np.inf
    if shape == HEIGHT_FIELD:
        return _height_hit(scene.waves, solid, (ox, oy, oz), (dx, dy, dz), enter, leave)
    if shape == FREE_FORM:
        return _free_form_hit(scene.waves, scene.forms, solid, (ox, oy, oz), (dx, dy, dz), enter, leave)
    if scene.cut_shapes[solid] != UNCUT:
        return _cut_hit(scene.cuts, scene.cut_shapes[solid], solid, (ox, oy, oz), (dx, dy, dz), enter, leave)
    return enter if enter > NEAR else leave


@_inlined()
def _interval(shape: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> tuple[float, float]:
    """The interval of a line o + t d in a unit ball, cylinder or, for all other shapes, cube; enter > leave if none."""
    if shape == ELLIPSOID:
        return _quadratic(dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1.0)
    enter, leave = _slab(oy, dy)
    if shape == CYLINDER:
        enter_r, leave_r = _quadratic(dx * dx + dz * dz, ox * dx + oz * dz, ox * ox + oz * oz - 1.0)
        return max(enter, enter_r), min(leave, leave_r)
    enter_x, leave_x = _slab(ox, dx)
    enter_z, leave_z = _slab(oz, dz)
    return max(enter, enter_x, enter_z), min(leave, leave_x, leave_z)


@_compiled()  # a call: inlined it would make the loop over the solids slower for scenes without cuts
def _cut_hit(
    cuts: np.ndarray,
    cut_shape: int,
    solid: int,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    enter: float,
    leave: float,
) -> float:
    """The first surface of a solid that a ray is in from `enter` to `leave`, less what is cut out of it."""
    ox, oy, oz = _in_cut(cuts, solid, origin[0], origin[1], origin[2], 1.0)
    dx, dy, dz = _in_cut(cuts, solid, direction[0], direction[1], direction[2], 0.0)
    into, out = _interval(cut_shape, ox, oy, oz, dx, dy, dz)
    if into > out:
        return enter if enter > NEAR else leave
    # What is left of the interval: before the cut, and behind it.
    end, start = min(leave, into), max(enter, out)
    if enter <= end and end > NEAR:
        return enter if enter > NEAR else end
    if start <= leave and leave > NEAR:
        return start if start > NEAR else leave
    return np.inf


@_inlined()
def _in_cut(cuts: np.ndarray, solid: int, x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """A point (w = 1) or direction (w = 0) of the solid's unit frame in the unit frame of what is cut out of it."""
    return (
        cuts[solid, 0, 0] * x + cuts[solid, 0, 1] * y + cuts[solid, 0, 2] * z + cuts[solid, 0, 3] * w,
        cuts[solid, 1, 0] * x + cuts[solid, 1, 1] * y + cuts[solid, 1, 2] * z + cuts[solid, 1, 3] * w,
        cuts[solid, 2, 0] * x + cuts[solid, 2, 1] * y + cuts[solid, 2, 2] * z + cuts[solid, 2, 3] * w,
    )


@_inlined()
def _cut_normal(scene: Scene, solid: int, ux: float, uy: float, uz: float) -> tuple[bool, float, float, float]:
    """Whether a surface point in the unit frame is on the surface of the cut, and the normal in the local frame.

    The normal is not of unit length.
    """
    shape = scene.cut_shapes[solid]
    x, y, z = _in_cut(scene.cuts, solid, ux, uy, uz, 1.0)
    nx, ny, nz = x, y, z
    if shape == ELLIPSOID:
        gap = np.sqrt(x * x + y * y + z * z) - 1.0
    elif shape == CYLINDER:
        across, along = np.sqrt(x * x + z * z) - 1.0, abs(y) - 1.0
        gap = max(across, along)
        nx, ny, nz = (x, 0.0, z) if across > along else (0.0, y, 0.0)
    else:
        ax, ay, az = abs(x), abs(y), abs(z)
        gap = max(ax, ay, az) - 1.0
        nx, ny, nz = (x, 0.0, 0.0) if ax >= max(ay, az) else ((0.0, y, 0.0) if ay >= az else (0.0, 0.0, z))
    cuts, halves = scene.cuts, scene.halves  # a normal is transformed by the transpose
    return (
        abs(gap) < ON_SURFACE,
        (cuts[solid, 0, 0] * nx + cuts[solid, 1, 0] * ny + cuts[solid, 2, 0] * nz) / halves[solid, 0],
        (cuts[solid, 0, 1] * nx + cuts[solid, 1, 1] * ny + cuts[solid, 2, 1] * nz) / halves[solid, 1],
        (cuts[solid, 0, 2] * nx + cuts[solid, 1, 2] * ny + cuts[solid, 2, 2] * nz) / halves[solid, 2],
    )


@_compiled()
def _free_form_hit(
    waves: np.ndarray,
    forms: np.ndarray,
    solid: int,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    enter: float,
    leave: float,
) -> float:
    """The first surface of a free-form solid whose cube a ray is in from `enter` to `leave`.

    Steps are as long as the implicit function's largest slope allows, but at least LEAST_STEP; where the sign changes,
    the surface is found by bisection.
    """
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    speed = np.sqrt(dx * dx + dy * dy + dz * dz)
    low = max(enter, NEAR)
    value = _form(waves, forms, solid, ox + low * dx, oy + low * dy, oz + low * dz)
    inside = value < 0.0
    while low < leave:
        high = low + max(abs(value) / forms[solid, 1], LEAST_STEP) / speed
        value = _form(waves, forms, solid, ox + high * dx, oy + high * dy, oz + high * dz)
        if (value < 0.0) != inside:
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if (_form(waves, forms, solid, ox + middle * dx, oy + middle * dy, oz + middle * dz) < 0.0) == inside:
                    low = middle
                else:
                    high = middle
            return high
        low = high
    return np.inf


@_inlined()
def _form(waves: np.ndarray, forms: np.ndarray, solid: int, x: float, y: float, z: float) -> float:
    """The implicit function of a free-form solid at a point of the unit frame, negative inside.

    f = |p| - 1 + sum a (1 + p(kx x + ky y + kz z + phase)) over waves (kx, kz, phase, a, ky), p as in `_wave_sum`; the
    norm |p| is (1 - s) |p|_2 + s |p|_4 for the squareness s: a ball at 0, a rounded cube at 1.
    """
    xx, yy, zz = x * x, y * y, z * z
    square = forms[solid, 0]
    value = (1.0 - square) * np.sqrt(xx + yy + zz) + square * np.sqrt(np.sqrt(xx * xx + yy * yy + zz * zz)) - 1.0
    for wave in range(WAVES):
        value += waves[solid, wave, 3]
    return value + _wave_sum(waves, solid, x, y, z)


@_inlined()
def _form_slope(
    waves: np.ndarray, forms: np.ndarray, solid: int, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """The derivatives of `_form` by x, y and z."""
    xx, yy, zz = x * x, y * y, z * z
    by_ball = (1.0 - forms[solid, 0]) / np.sqrt(xx + yy + zz)
    by_cube = forms[solid, 0] / (xx * xx + yy * yy + zz * zz) ** 0.75
    by_x, by_y, by_z = _wave_slope(waves, solid, x, y, z)
    return by_x + x * (by_ball + by_cube * xx), by_y + y * (by_ball + by_cube * yy), by_z + z * (by_ball + by_cube * zz)


@_inlined()
def _height_hit(
    waves: np.ndarray,
    solid: int,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    enter: float,
    leave: float,
) -> float:
    """The first surface of a height field whose cube a ray is in from `enter` to `leave`: sides, bottom or waves."""
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    start = max(enter, NEAR)
    step = (leave - start) / MARCH_STEPS
    inside = oy + start * dy > _height(waves, solid, ox + start * dx, oz + start * dz)
    if inside and enter > NEAR:
        return enter
    for index in range(MARCH_STEPS):
        low = start + index * step
        high = low + step
        if (oy + high * dy > _height(waves, solid, ox + high * dx, oz + high * dz)) == inside:
            continue
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if (oy + middle * dy > _height(waves, solid, ox + middle * dx, oz + middle * dz)) == inside:
                low = middle
            else:
                high = middle
        return high
    return leave if inside else np.inf


@_inlined()
def _height(waves: np.ndarray, solid: int, x: float, z: float) -> float:
    """The surface's y at (x, z) of the unit frame."""
    return _wave_sum(waves, solid, x, 0.0, z)


@_inlined()
def _wave_sum(waves: np.ndarray, solid: int, x: float, y: float, z: float) -> float:
    """The sum of a p(kx x + ky y + kz z + phase) over waves (kx, kz, phase, a, ky); ky is 0 for a height field.

    p has period 1 and values from -1 to 1. It is a sine made of parabolas, which takes less time.
    """
    value = 0.0
    for wave in range(WAVES):
        turn = _turn(waves, solid, wave, x, y, z)
        value += waves[solid, wave, 3] * 8.0 * turn * (1.0 - 2.0 * abs(turn))
    return value


@_inlined()
def _wave_slope(waves: np.ndarray, solid: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The derivatives of `_wave_sum` by x, y and z."""
    by_x, by_y, by_z = 0.0, 0.0, 0.0
    for wave in range(WAVES):
        turn = _turn(waves, solid, wave, x, y, z)
        slope = waves[solid, wave, 3] * 8.0 * (1.0 - 4.0 * abs(turn))
        by_x, by_z = by_x + slope * waves[solid, wave, 0], by_z + slope * waves[solid, wave, 1]
        by_y += slope * waves[solid, wave, 4]
    return by_x, by_y, by_z


@_inlined()
def _turn(waves: np.ndarray, solid: int, wave: int, x: float, y: float, z: float) -> float:
    """The phase of one wave at a point, in periods, from -1/2 to 1/2."""
    turn = waves[solid, wave, 0] * x + waves[solid, wave, 4] * y + waves[solid, wave, 1] * z + waves[solid, wave, 2]
    return turn - np.floor(turn + 0.5)


@_inlined()
def _slab(origin: float, direction: float) -> tuple[float, float]:
    """The interval of a line between the planes at -1 and 1 of one axis."""
    inverse = 1.0 / direction
    a, b = (-1.0 - origin) * inverse, (1.0 - origin) * inverse
    return min(a, b), max(a, b)


@_inlined()
def _quadratic(a: float, b: float, c: float) -> tuple[float, float]:
    """The roots of a t^2 + 2 b t + c; an empty interval if there are none."""
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return np.inf, -np.inf
    root = np.sqrt(discriminant)
    return (-b - root) / a, (-b + root) / a


@_inlined()
def _face(scene: Scene, solid: int, ux: float, uy: float, uz: float) -> tuple[int, float, float, float]:
    """The face (see `Scene.materials`) of a surface point in the unit frame, and the normal there.

    The normal is in the local frame and not of unit length.
    """
    shape = scene.shapes[solid]
    nx, ny, nz = ux / scene.halves[solid, 0], uy / scene.halves[solid, 1], uz / scene.halves[solid, 2]
    on_cut, cut_x, cut_y, cut_z = False, 0.0, 0.0, 0.0
    if scene.cut_shapes[solid] != UNCUT:
        on_cut, cut_x, cut_y, cut_z = _cut_normal(scene, solid, ux, uy, uz)
    if on_cut:
        nx, ny, nz, shape = cut_x, cut_y, cut_z, ELLIPSOID
    elif shape == FREE_FORM:
        nx, ny, nz = _form_slope(scene.waves, scene.forms, solid, ux, uy, uz)
        nx, ny, nz = nx / scene.halves[solid, 0], ny / scene.halves[solid, 1], nz / scene.halves[solid, 2]
    elif shape == ELLIPSOID and solid == 0:
        return SKY_FACE, nx, ny, nz
    elif shape == HEIGHT_FIELD and max(abs(ux), abs(uy), abs(uz)) < 1.0 - ON_SURFACE:
        by_x, _, by_z = _wave_slope(scene.waves, solid, ux, 0.0, uz)
        nx, ny, nz = by_x / scene.halves[solid, 0], -1.0 / scene.halves[solid, 1], by_z / scene.halves[solid, 2]
        return 2, nx, ny, nz
    elif shape in (BOX, HEIGHT_FIELD):
        shape, nx, ny, nz = BOX, ux, uy, uz
    elif shape == CYLINDER:
        nx, ny, nz = (0.0, uy, 0.0) if uy * uy > 1.0 - ON_SURFACE else (nx, 0.0, nz)
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    axis = 0 if ax >= ay and ax >= az else (1 if ay >= az else 2)
    along = nx if axis == 0 else (ny if axis == 1 else nz)
    if shape == BOX:
        nx, ny, nz = along if axis == 0 else 0.0, along if axis == 1 else 0.0, along if axis == 2 else 0.0
    return 2 * axis + (1 if along > 0.0 else 0), nx, ny, nz


@_inlined()
def _light(
    scene: Scene,
    camera_to_world: np.ndarray,
    solid: int,
    face: int,
    ray: tuple[float, float, float],
    unit_point: tuple[float, float, float],
    normal: tuple[float, float, float],
) -> tuple[float, float, float, float, float]:
    """Diffuse light (3 channels) and specular highlight of a surface point; log2 of texels per unit of ray width.

    ray: (x, y) and the z-depth at which it meets the point. unit_point: the point in the solid's unit frame.
    """
    x, y, z = ray
    c, axes = camera_to_world, scene.axes
    rx = c[0, 0] * x + c[0, 1] * y + c[0, 2]
    ry = c[1, 0] * x + c[1, 1] * y + c[1, 2]
    rz = c[2, 0] * x + c[2, 1] * y + c[2, 2]
    px, py, pz = c[0, 3] + z * rx, c[1, 3] + z * ry, c[2, 3] + z * rz
    length = np.sqrt(rx * rx + ry * ry + rz * rz)
    rx, ry, rz = rx / length, ry / length, rz / length
    nx = axes[solid, 0, 0] * normal[0] + axes[solid, 1, 0] * normal[1] + axes[solid, 2, 0] * normal[2]
    ny = axes[solid, 0, 1] * normal[0] + axes[solid, 1, 1] * normal[1] + axes[solid, 2, 1] * normal[2]
    nz = axes[solid, 0, 2] * normal[0] + axes[solid, 1, 2] * normal[1] + axes[solid, 2, 2] * normal[2]
    slope = nx * rx + ny * ry + nz * rz
    norm = np.sqrt(nx * nx + ny * ny + nz * nz) * (-1.0 if slope > 0.0 else 1.0)  # towards the camera
    nx, ny, nz, slope = nx / norm, ny / norm, nz / norm, slope / norm

    material = scene.materials[solid, face]
    spread = np.log2(SIZE * scene.frequencies[material] * z * length / np.sqrt(max(-slope, 0.02)))
    dim = _corner_occlusion(scene, unit_point, face) if solid == 0 else 1.0
    emission = scene.emissions[material]
    if emission >= LUMINOUS:
        return emission, emission, emission, 0.0, spread
    light_r, light_g, light_b = scene.ambient[0], scene.ambient[1], scene.ambient[2]
    specular = 0.0
    for light in range(len(scene.light_lengths)):
        vx = scene.light_positions[light, 0] - px
        vy = scene.light_positions[light, 1] - py
        vz = scene.light_positions[light, 2] - pz
        distance = np.sqrt(vx * vx + vy * vy + vz * vz)
        cosine = (nx * vx + ny * vy + nz * vz) / distance
        if cosine <= 0.0:
            continue
        relative = distance / scene.light_reaches[light]
        strength = 1.0 / (1.0 + relative * relative)
        if scene.light_lengths[light] >= 0.0:
            strength *= _lamp_visibility(scene, light, px, py, pz, nx, ny, nz)
        light_r += strength * cosine * scene.light_colours[light, 0]
        light_g += strength * cosine * scene.light_colours[light, 1]
        light_b += strength * cosine * scene.light_colours[light, 2]
        if scene.speculars[material] > 0.0:  # Phong: the reflected ray towards the light
            mirrored = ((rx - 2 * slope * nx) * vx + (ry - 2 * slope * ny) * vy + (rz - 2 * slope * nz) * vz) / distance
            specular += strength * scene.speculars[material] * max(mirrored, 0.0) ** 24
    return emission + dim * light_r, emission + dim * light_g, emission + dim * light_b, specular, spread


@_inlined()
def _texel(
    scene: Scene,
    texels: np.ndarray,
    solid: int,
    face: int,
    material: int,
    ux: float,
    uy: float,
    uz: float,
    detail: float,
) -> tuple[float, float, float]:
    """The material's colour at a point of the unit frame, bilinear in the mipmap level floor(detail)."""
    lx, ly, lz = ux * scene.halves[solid, 0], uy * scene.halves[solid, 1], uz * scene.halves[solid, 2]
    a, b = (lz, ly) if face < 2 else ((lx, lz) if face < 4 else (lx, ly))
    u = scene.uv[material, 0, 0] * a + scene.uv[material, 0, 1] * b + scene.uv[material, 0, 2]
    v = scene.uv[material, 1, 0] * a + scene.uv[material, 1, 1] * b + scene.uv[material, 1, 2]
    level = min(max(int(detail), 0), LEVELS - 1)
    size, start = SIZE, 0
    for _ in range(level):
        start += size * size
        size //= 2
    u, v = u * size - 0.5, v * size - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - column, v - row
    x0, x1 = column & (size - 1), (column + 1) & (size - 1)
    y0, y1 = start + (row & (size - 1)) * size, start + ((row + 1) & (size - 1)) * size
    bank = scene.textures[material]
    w00, w01, w10, w11 = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
    i00, i01, i10, i11 = y0 + x0, y0 + x1, y1 + x0, y1 + x1
    red = (
        w00 * texels[bank, i00, 0]
        + w01 * texels[bank, i01, 0]
        + w10 * texels[bank, i10, 0]
        + w11 * texels[bank, i11, 0]
    )
    green = (
        w00 * texels[bank, i00, 1]
        + w01 * texels[bank, i01, 1]
        + w10 * texels[bank, i10, 1]
        + w11 * texels[bank, i11, 1]
    )
    blue = (
        w00 * texels[bank, i00, 2]
        + w01 * texels[bank, i01, 2]
        + w10 * texels[bank, i10, 2]
        + w11 * texels[bank, i11, 2]
    )
    red, green, blue = red / 255, green / 255, blue / 255
    return (
        max(
            scene.colours[material, 0, 0] * red
            + scene.colours[material, 0, 1] * green
            + scene.colours[material, 0, 2] * blue
            + scene.colours[material, 0, 3],
            0.0,
        ),
        max(
            scene.colours[material, 1, 0] * red
            + scene.colours[material, 1, 1] * green
            + scene.colours[material, 1, 2] * blue
            + scene.colours[material, 1, 3],
            0.0,
        ),
        max(
            scene.colours[material, 2, 0] * red
            + scene.colours[material, 2, 1] * green
            + scene.colours[material, 2, 2] * blue
            + scene.colours[material, 2, 3],
            0.0,
        ),
    )


@_inlined()
def _corner_occlusion(scene: Scene, unit_point: tuple[float, float, float], face: int) -> float:
    """Ambient occlusion factor of a point of the enclosing solid, lower near its edges."""
    gap_x = np.inf if face < 2 else scene.halves[0, 0] * (1 - abs(unit_point[0]))
    gap_y = np.inf if 2 <= face < 4 else scene.halves[0, 1] * (1 - abs(unit_point[1]))
    gap_z = np.inf if face >= 4 else scene.halves[0, 2] * (1 - abs(unit_point[2]))
    return 1.0 - CORNER_STRENGTH * np.exp(-min(gap_x, gap_y, gap_z) / CORNER_RANGE)


@_inlined()
def _lamp_visibility(
    scene: Scene, light: int, px: float, py: float, pz: float, nx: float, ny: float, nz: float
) -> float:
    """The visible share of a lamp from a surface point; if both ends are visible or hidden, so is the rest."""
    ox, oy, oz = px + 2 * NEAR * nx, py + 2 * NEAR * ny, pz + 2 * NEAR * nz
    visible = 0.0
    for turn in range(LAMP_SAMPLES):
        place = turn - 1 if turn > 1 else turn * (LAMP_SAMPLES - 1)  # the ends first
        shift = scene.light_lengths[light] * (2 * place / (LAMP_SAMPLES - 1) - 1)
        dx = scene.light_positions[light, 0] + 0.7 * shift - ox
        dy = scene.light_positions[light, 1] - oy
        dz = scene.light_positions[light, 2] + 0.7 * shift - oz
        if not _blocked(scene, ox, oy, oz, dx, dy, dz):
            visible += 1.0
        if turn == 1 and visible != 1.0:
            return visible / 2
    return visible / LAMP_SAMPLES


@_inlined()
def _blocked(scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> bool:
    """Whether the segment from o to o + d meets a solid, except the enclosing one and emissive ones."""
    squared = dx * dx + dy * dy + dz * dz
    if squared > FAR_LIGHT * FAR_LIGHT:
        shorter = SHADOW_REACH / np.sqrt(squared)
        dx, dy, dz, squared = shorter * dx, shorter * dy, shorter * dz, SHADOW_REACH * SHADOW_REACH
    for solid in range(1, len(scene.shapes)):
        # Bounding sphere against the line.
        wx, wy, wz = scene.centres[solid, 0] - ox, scene.centres[solid, 1] - oy, scene.centres[solid, 2] - oz
        along = (wx * dx + wy * dy + wz * dz) / squared
        off_x, off_y, off_z = wx - along * dx, wy - along * dy, wz - along * dz
        half_x, half_y, half_z = scene.halves[solid, 0], scene.halves[solid, 1], scene.halves[solid, 2]
        ball = half_x * half_x + half_y * half_y + half_z * half_z
        if off_x * off_x + off_y * off_y + off_z * off_z > ball:
            continue
        t = _unit_hit(
            scene,
            solid,
            -_along(scene.axes, solid, 0, wx, wy, wz) / half_x,
            -_along(scene.axes, solid, 1, wx, wy, wz) / half_y,
            -_along(scene.axes, solid, 2, wx, wy, wz) / half_z,
            _along(scene.axes, solid, 0, dx, dy, dz) / half_x,
            _along(scene.axes, solid, 1, dx, dy, dz) / half_y,
            _along(scene.axes, solid, 2, dx, dy, dz) / half_z,
        )
        if t < 1.0 and scene.emissions[scene.materials[solid, 0]] == 0.0:
            return True
    return False


@_inlined()
def _along(axes: np.ndarray, solid: int, axis: int, x: float, y: float, z: float) -> float:
    """The component of (x, y, z) along one of a solid's axes."""
    return axes[solid, axis, 0] * x + axes[solid, axis, 1] * y + axes[solid, axis, 2] * z
