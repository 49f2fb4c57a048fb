"""How reliably defects of images are found: false alarms on the validation captures, and frames that are made bad.

    python -P -m idesplat.tools.evaluation.captures.spoiled --checkouts DIR

False alarms are counted among all frames of a capture at once, where each can be compared with others, and in pairs of
a frame and its best partner, alone; in captures whose object was moved between the images, frames of another state
than most are no false alarms. Then frames are blurred, blackened, overexposed, or exchanged for others, and are
looked for in a pair with their best partner, beside all other frames and alone.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rich.table import Table

from ....runtime.cameras.camera import Camera
from ....runtime.cli.terminal import run, say
from ....runtime.errors import InputError
from ....runtime.images.colormaps import to_uint8
from ....runtime.views.checks import Defect, find_defects
from ....runtime.views.loader import ViewLoader
from ....runtime.views.selection import PairScorer, guess_scene_depths
from ..report import print_table
from .capture import Capture, load_shrunk, read_captures
from .checkouts import frames_of

Posed = tuple[np.ndarray, Camera]  # image, uint8 RGB [height, width, 3], and its camera
Spoil = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # of a frame, another frame, another scene

SIDE = 1024  # pixels: longer side of the images, in whose pixels the blur is given
NETWORK_SIZE = 256, 256
GAMMA = 2.2  # of the display, by which overexposed pixels are found
NOISE = 3.0  # standard deviation in grey levels, of images that show nothing
MOVED = ("can",)  # captures whose object was moved between the images, as their backgrounds show


def count_spoiled(
    checkouts: Annotated[Path, typer.Option(help="Folder of checkouts; missing ones are cloned into it.")],
    capture: Annotated[list[str] | None, typer.Option(help="Use this capture alone; may be repeated.")] = None,
    frames: Annotated[int, typer.Option(help="Frames of each capture that are made bad.", min=2)] = 4,
) -> None:
    """Count false alarms and detections of the checks of images."""
    read_captures(capture or ())  # an unknown one is refused before all are loaded
    named = {source.name: _load(source, checkouts) for source in read_captures()}
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])  # found beside others, found alone, tried
    alarms = np.zeros(2, int)
    tried = 0
    for name in capture or named:
        pairs = named[name]
        partners = _partners([camera for _, camera in pairs])
        alarms += _false_alarms(name, pairs, partners)
        tried += len(pairs)
        other_scenes = [other[len(other) // 2][0] for key, other in named.items() if key != name]
        spread = np.linspace(0, len(pairs) - 1, min(frames, len(pairs))).round().astype(int)
        for number, index in enumerate(spread.tolist()):
            for kind, spoil in SPOILED.items():
                partner, other = int(partners[index]), int(spread[number - 1])
                if other in (index, partner):
                    continue
                image, camera = pairs[index]
                spoiled = spoil(image, pairs[other][0], other_scenes[number % len(other_scenes)])
                given = [*pairs[:index], (_resized(spoiled, image), camera), *pairs[index + 1 :]]
                beside = _found(given, [index, partner], range(len(given)))
                counts[kind][0] += index in {defect.index for defect in beside}
                counts[kind][1] += bool(_found(given, [index, partner], [index, partner]))
                counts[kind][2] += 1
    say(f"false alarms: {alarms[0]} of {tried} frames beside all others, {alarms[1]} of {tried} in pairs alone")
    table = Table()
    for heading in ("made bad", "found beside others", "found alone", "tried"):
        table.add_column(heading, justify="left" if heading == "made bad" else "right")
    for kind, numbers in counts.items():
        table.add_row(kind, *map(str, numbers))
    print_table(table)


def _load(capture: Capture, checkouts: Path) -> list[Posed]:
    """All frames of a capture, reduced, with their cameras."""
    with frames_of(checkouts, capture) as folder:
        return [load_shrunk(capture, folder, name, SIDE) for name in capture.frames]


def _partners(cameras: Sequence[Camera]) -> np.ndarray:
    """The index of the best partner of each camera, [cameras]."""
    scorer, count = PairScorer(cameras, guess_scene_depths(cameras)), len(cameras)
    first, second = np.divmod(np.arange(count**2), count)
    cost = scorer.score(first, second).cost.reshape(count, count)
    np.fill_diagonal(cost, np.inf)
    return cost.argmin(axis=1)


def _false_alarms(name: str, pairs: Sequence[Posed], partners: np.ndarray) -> tuple[int, int]:
    """How many frames of a good capture are said to be bad: beside all others, and in pairs."""
    everything = range(len(pairs))
    found = _found(pairs, everything, everything)
    moved = {defect.index for defect in found if name in MOVED and defect.contradicts}
    if moved:
        say(f"{name}: {len(moved)} of {len(pairs)} frames show another state of the scene")
    beside = {defect.index for defect in found} - moved
    alone = {index for index in everything if _found(pairs, [index, partners[index]], [index, partners[index]])}
    for index in sorted(beside | alone):
        say(f"{name}, {pairs[index][1].name}: false alarm")
    return len(beside), len(alone)


def _found(pairs: Sequence[Posed], chosen: Sequence[int], usable: Sequence[int]) -> list[Defect]:
    """The defects of the chosen images; of all, if they are refused together."""
    loader = ViewLoader(pairs, *NETWORK_SIZE, match=True)
    try:
        return find_defects(loader, sorted(chosen), sorted(usable), cameras=True)
    except InputError as error:
        return [Defect(index, str(error)) for index in chosen]


def _resized(image: np.ndarray, like: np.ndarray) -> np.ndarray:
    return cv2.resize(image, like.shape[1::-1], interpolation=cv2.INTER_AREA)


# ---- making images bad


def _defocus(radius: int) -> Spoil:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return _blurred(np.hypot(x, y) <= radius)


def _motion(length: int) -> Spoil:
    return _blurred(np.eye(round(length / np.sqrt(2))))  # along a diagonal


def _blurred(kernel: np.ndarray) -> Spoil:
    weights = (kernel / kernel.sum()).astype(np.float32)
    return lambda image, *_: cv2.filter2D(image, -1, weights, borderType=cv2.BORDER_REFLECT)


def _uniform(level: int) -> Spoil:
    rng = np.random.default_rng(0)
    return lambda image, *_: np.clip(rng.normal(level, NOISE, image.shape), 0, 255).astype(np.uint8)


def _overexposed(stops: int) -> Spoil:
    return lambda image, *_: to_uint8(image / 255 * 2 ** (stops / GAMMA))


SPOILED: dict[str, Spoil] = {
    **{f"out of focus, radius {radius} pixels": _defocus(radius) for radius in (2, 4, 8)},
    **{f"moved by {length} pixels": _motion(length) for length in (8, 14, 24, 40)},
    "black": _uniform(2),
    "grey": _uniform(120),
    **{f"overexposed by {stops} stops": _overexposed(stops) for stops in (3, 5)},
    "of another scene": lambda image, other_frame, other_scene: other_scene,
    "with the pose of another view": lambda image, other_frame, other_scene: other_frame,
}


def main() -> None:
    """Run the command."""
    run(count_spoiled)


if __name__ == "__main__":
    main()
