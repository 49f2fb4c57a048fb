"""Procedural textures of synthetic scenes, tileable, with mipmaps."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

SIZE = 256  # texels along one period at the finest level
LEVELS = 7  # mipmap levels: 256, 128, ... 4 texels
# The kind of textures that are crops of images (`photo_textures`).
PHOTO_KIND = "photo"


@dataclass(frozen=True)
class Textures:
    """A bank of textures.

    texels: every level of every texture, finest first, uint8 [textures, texels of all levels, 3].
    kinds: a key of PATTERNS, or PHOTO_KIND, for each texture.
    """

    texels: np.ndarray
    kinds: tuple[str, ...]

    def of_kind(self, *kinds: str) -> list[int]:
        """Indices of the textures of the given kinds."""
        return [index for index, kind in enumerate(self.kinds) if kind in kinds]


@cache
def texture_bank(seed: int, count: int) -> Textures:
    """`count` textures that cycle through the kinds; depends on the seed alone. Each takes some 10 ms and 256 KiB."""
    names = list(PATTERNS)
    kinds = tuple(names[index % len(names)] for index in range(count))
    texels = [mip_levels(PATTERNS[kind](np.random.default_rng([seed, index]))) for index, kind in enumerate(kinds)]
    return Textures(np.stack(texels), kinds)


def mip_levels(colours: np.ndarray) -> np.ndarray:
    """All mipmap levels of `colours` [SIZE, SIZE, 3], concatenated, uint8 [texels, 3]."""
    levels = [colours.clip(0, 1).astype(np.float32)]
    for _ in range(LEVELS - 1):
        half = levels[-1].shape[0] // 2
        levels.append(np.asarray(cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA), np.float32))
    return np.concatenate([np.rint(level * 255).astype(np.uint8).reshape(-1, 3) for level in levels])


def _palette(rng: np.random.Generator, count: int | np.integer) -> np.ndarray:
    """A random palette [count, 3], RGB: hues near one or two base hues, mostly of low saturation."""
    hues = rng.uniform(0, 360) + rng.normal(0, 25, count) + 180 * (rng.random(count) < 0.2)
    saturations = rng.beta(1.6, 2.6) * rng.uniform(0.6, 1.2, count)
    values = rng.uniform(0.15, 1.0, count)
    hsv = np.stack([hues % 360, saturations.clip(0, 1), values], axis=-1).astype(np.float32)
    return cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]


def _interpolate_palette(values: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """`values` in [0, 1] as colours, interpolated linearly in `palette` [colours, 3]."""
    stops = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(values, stops, palette[:, channel]) for channel in range(3)], axis=-1)


def _fractal(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> np.ndarray:
    """Periodic noise [SIZE, SIZE] of unit standard deviation with amplitude spectrum |f|^-slope.

    White noise is filtered in the Fourier domain. stretch: factor by which features are longer along x.
    """
    fy = np.fft.fftfreq(SIZE)[:, None]
    fx = np.fft.rfftfreq(SIZE)[None, :] * stretch
    frequency = np.hypot(fx, fy)
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * frequency**-slope, s=(SIZE, SIZE))
    return noise / noise.std()


def _to_unit_range(noise: np.ndarray) -> np.ndarray:
    """Noise of unit standard deviation, scaled and clipped to [0, 1]."""
    return (0.5 + 0.2 * noise).clip(0, 1)


def _add_grain(rng: np.random.Generator, colours: np.ndarray) -> np.ndarray:
    """`colours` with fractal noise in brightness."""
    grain = rng.uniform(0.01, 0.08) * _fractal(rng, rng.uniform(0.2, 1.4))
    return colours * (1 + grain[..., None])


def _grid() -> tuple[np.ndarray, np.ndarray]:
    """Texel coordinates x [1, SIZE] and y [SIZE, 1] in [0, 1)."""
    steps = (np.arange(SIZE) + 0.5) / SIZE
    return steps[None, :], steps[:, None]


def _noise(rng: np.random.Generator) -> np.ndarray:
    values = _fractal(rng, rng.uniform(0.7, 1.8), rng.choice([1.0, 1.0, 3.0]))
    if rng.random() < 0.3:  # veins
        values = 2 - 4 * np.abs(values)
    if rng.random() < 0.25:  # patches
        values = 4 * np.tanh(4 * values) / 2
    return _interpolate_palette(_to_unit_range(values), _palette(rng, rng.integers(2, 6)))


def _plain(rng: np.random.Generator) -> np.ndarray:
    """A painted wall or a sheet of paper: almost no texture."""
    colour = _palette(rng, 1)[0] * 0.5 + rng.uniform(0.25, 0.5)
    values = rng.uniform(0.002, 0.02) * _fractal(rng, 0.2) + rng.uniform(0.0, 0.025) * _fractal(rng, 1.5)
    return colour + values[..., None] * np.ones(3)


def _brick(rng: np.random.Generator) -> np.ndarray:
    rows, columns = 2 * rng.integers(2, 7), rng.integers(2, 6)
    x, y = _grid()
    row = np.floor(y * rows).astype(int)
    shifted = x * columns + (row % 2) * rng.choice([0.0, 0.5])
    column = np.floor(shifted).astype(int) % columns
    shades = rng.random((rows, columns))[row, column]
    wobble = 0.015 * _fractal(rng, 1.2)
    edge_x = np.abs((shifted + wobble) % 1 - 0.5) > 0.5 - rng.uniform(0.01, 0.05)
    edge_y = np.abs((y * rows + wobble) % 1 - 0.5) > 0.5 - rng.uniform(0.02, 0.1)
    colours = _interpolate_palette(shades * rng.uniform(0.3, 1.0), _palette(rng, 3))
    return _add_grain(rng, np.where((edge_x | edge_y)[..., None], _palette(rng, 1)[0], colours))


def _checker(rng: np.random.Generator) -> np.ndarray:
    count = 2 * rng.integers(1, 7)
    x, y = _grid()
    column, row = np.floor(x * count).astype(int), np.floor(y * count).astype(int)
    shades = (column + row) % 2 * 0.9 + 0.1 * rng.random((count, count))[row, column]
    return _add_grain(rng, _interpolate_palette(shades, _palette(rng, 2)))


def _wood(rng: np.random.Generator) -> np.ndarray:
    """Planks along x, each with another part of the same grain."""
    planks = int(rng.choice([1, 2, 4, 8]))
    grain = _fractal(rng, rng.uniform(0.9, 1.4), rng.uniform(6, 20))
    rows = np.arange(SIZE)
    plank = rows * planks // SIZE
    shifts = rng.integers(0, SIZE, planks)[plank]
    grain = grain[rows[:, None], (np.arange(SIZE)[None, :] + shifts[:, None]) % SIZE]
    rings = np.sin(grain * rng.uniform(2, 6) + 12 * _grid()[1]) * 0.5 + 0.5
    shades = 0.5 * rings + 0.35 * _to_unit_range(grain) + 0.15 * rng.random(planks)[plank][:, None]
    dark, light = np.array([0.25, 0.14, 0.07]), np.array([0.82, 0.62, 0.4])
    tones = dark + (light - dark) * np.sort(rng.random(2))[:, None] + rng.normal(0, 0.04, (2, 3))
    seam = (rows % (SIZE // planks) < 2) & (planks > 1)
    return _add_grain(rng, _interpolate_palette(shades, tones) * np.where(seam, 0.45, 1.0)[:, None, None])


def _stripes(rng: np.random.Generator) -> np.ndarray:
    edges = np.sort(rng.random(rng.integers(3, 16)))
    palette = _palette(rng, len(edges) + 1)
    palette[-1] = palette[0]  # the first and last stripe meet where the texture repeats
    band = np.searchsorted(edges, np.arange(SIZE) / SIZE)
    colours = np.broadcast_to(palette[band][None], (SIZE, SIZE, 3))
    return _add_grain(rng, colours if rng.random() < 0.6 else colours.transpose(1, 0, 2))


def _speckle(rng: np.random.Generator) -> np.ndarray:
    """Terrazzo, granite, dotted cloth: disks of many sizes."""
    palette = _palette(rng, 6)
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    canvas[:] = palette[0]
    for _ in range(rng.integers(60, 400)):
        radius = min(int(rng.pareto(2.0) * 2 + 1), 30)
        x, y = rng.integers(0, SIZE, 2).tolist()
        colour = palette[rng.integers(1, 6)].tolist()
        for dx, dy in _tiled_positions(x, y, radius):
            cv2.circle(canvas, (dx, dy), radius, colour, -1)
    return _add_grain(rng, canvas)


def _tiled_positions(x: int, y: int, reach: int) -> list[tuple[int, int]]:
    """All positions at which a mark of radius `reach` at (x, y) is placed for the texture to tile."""
    places = [(x + SIZE * i, y + SIZE * j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return [(u, v) for u, v in places if -reach <= u < SIZE + reach and -reach <= v < SIZE + reach]


def _glyphs(rng: np.random.Generator) -> np.ndarray:
    """Lines of text on paper."""
    paper, ink = _palette(rng, 2)
    paper, ink = (paper * 0.4 + 0.6, ink * 0.4) if rng.random() < 0.7 else (paper * 0.5, ink * 0.4 + 0.6)
    canvas = np.zeros((SIZE, SIZE), np.uint8)
    y = int(rng.integers(10, 40))
    font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX]))
    while y < SIZE:
        scale = rng.choice([0.35, 0.5, 0.8, 1.4])
        letters = "".join(chr(code) for code in rng.integers(48, 123, int(SIZE / (18 * scale))))
        cv2.putText(canvas, letters, (int(rng.integers(2, 20)), y), font, scale, 255, 1 + int(scale), cv2.LINE_AA)
        y += int(40 * scale * rng.uniform(0.8, 1.6)) + 4
    share = canvas[..., None] / 255
    return _add_grain(rng, paper * (1 - share) + ink * share)


def _gradient(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid()
    turns_x, turns_y = rng.integers(0, 3), rng.integers(1, 3)
    values = 0.5 + 0.5 * np.sin(2 * np.pi * (turns_x * x + turns_y * y + rng.random()))
    values = values + rng.uniform(0.0, 0.12) * _fractal(rng, 1.2)
    return _interpolate_palette(values.clip(0, 1), _palette(rng, rng.integers(2, 4)))


def _cells(rng: np.random.Generator) -> np.ndarray:
    """Paving stones, scales, leather: Voronoi cells of random points."""
    count = int(rng.choice([12, 30, 80, 200]))
    points = rng.random((count, 2)) * SIZE
    around = np.concatenate([points + SIZE * np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    seeds = np.full((3 * SIZE, 3 * SIZE), 255, np.uint8)
    columns, rows = (around + SIZE).astype(int).T
    seeds[rows, columns] = 0
    distance, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    point_of_label = np.zeros(label.max() + 1, int)
    point_of_label[label[rows, columns]] = np.arange(len(around)) % count
    inner = slice(SIZE, 2 * SIZE)
    shades = rng.random(count)[point_of_label[label[inner, inner]]]
    hollow = distance[inner, inner] * np.sqrt(count) / SIZE
    colours = _interpolate_palette(shades, _palette(rng, 4)) * (
        1 - rng.uniform(0.2, 0.9) * hollow[..., None].clip(0, 1)
    )
    return _add_grain(rng, colours)


def _weave(rng: np.random.Generator) -> np.ndarray:
    """Plaid and cloth: stripes in both directions, mixed."""
    along, across = _stripes(rng), _stripes(rng).transpose(1, 0, 2)
    x, y = _grid()
    threads = int(rng.choice([16, 32, 64]))
    over = np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
    return 0.5 * (along + across) * (1 + rng.uniform(0.05, 0.3) * over[..., None])


def _strokes(rng: np.random.Generator) -> np.ndarray:
    """Grass, carpet, straw, foliage: many short strokes."""
    palette = _palette(rng, 5)
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    canvas[:] = palette[0]
    length = rng.uniform(6, 30)
    heading, spread = rng.uniform(0, np.pi), rng.choice([0.3, 3.0])
    thickness = int(rng.integers(1, 4))
    for _ in range(500):
        x, y = rng.integers(0, SIZE, 2).tolist()
        angle = rng.normal(heading, spread)
        dx, dy = int(length * np.cos(angle)), int(length * np.sin(angle))
        colour = (palette[rng.integers(5)] * rng.uniform(0.6, 1.2)).tolist()
        for column, row in _tiled_positions(x, y, 31):
            cv2.line(canvas, (column, row), (column + dx, row + dy), colour, thickness)
    return canvas


def _collage(rng: np.random.Generator) -> np.ndarray:
    """A poster: a few large shapes on fractal noise."""
    canvas = _noise(rng).astype(np.float32)
    for colour in _palette(rng, rng.integers(6, 20)).tolist():
        centre = rng.integers(0, SIZE, 2)
        if rng.random() < 0.5:
            corners = centre + rng.normal(0, 45, (int(rng.integers(3, 6)), 2))
            cv2.fillPoly(canvas, [corners.astype(np.int32)], colour)
        else:
            axes = (int(rng.integers(5, 50)), int(rng.integers(5, 50)))
            cv2.ellipse(canvas, (int(centre[0]), int(centre[1])), axes, rng.uniform(0, 180), 0, 360, colour, -1)
    return _add_grain(rng, canvas)


# The order decides which texture of a bank has which kind; changing it changes all synthetic scenes.
PATTERNS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "noise": _noise,
    "plain": _plain,
    "brick": _brick,
    "checker": _checker,
    "wood": _wood,
    "stripes": _stripes,
    "speckle": _speckle,
    "glyphs": _glyphs,
    "gradient": _gradient,
    "cells": _cells,
    "weave": _weave,
    "strokes": _strokes,
    "collage": _collage,
}
