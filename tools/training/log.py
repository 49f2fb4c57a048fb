"""What a training run leaves to look at: JSON lines, curves, and pictures of predictions against truth."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...runtime.errors import raise_input_error
from ...runtime.system.files import atomic_write, read_bytes

CURVES_SIZE = (360, 900)  # pixels, of one curve
MARGIN = 60
SMOOTHED_OVER = 0.02  # of all points of a curve
# Relative errors from here on have the brightest colour.
WORST_ERROR = 0.3
LINE, FAINT, INK = (160, 80, 20), (225, 210, 195), (40, 40, 40)  # BGR


class TrainingLog:
    """One JSON object a line; when a run is resumed, lines after its checkpoint are dropped."""

    def __init__(self, path: Path, step: int) -> None:
        """`path`: the file. `step`: the number of steps done; lines of later ones are of a past that is repeated."""
        self.path = path
        self.entries = [entry for entry in _read(path) if entry["step"] <= step]
        with atomic_write(path) as temporary:
            temporary.write_text("".join(json.dumps(entry) + "\n" for entry in self.entries))

    def add(self, entry: dict[str, Any]) -> None:
        """Append one line, which has a `step`."""
        self.entries.append(entry)
        with self.path.open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def plot_curves(self, path: Path, names: Iterable[str]) -> None:
        """Write a PNG with one curve below another, for those of `names` that have been logged."""
        curves = {name: [(e["step"], e[name]) for e in self.entries if e.get(name) is not None] for name in names}
        panels = [_curve(name, np.array(points)) for name, points in curves.items() if points]
        if panels:
            _write(path, np.concatenate(panels))


def _read(path: Path) -> list[dict[str, Any]]:
    """The lines of a log; the last may be half written by a run that was killed, and is left out then.

    Raises InputError for any other line that this module does not write: rewriting the log would lose it.
    """
    if not path.exists() or (path.is_file() and not path.stat().st_size):
        return []
    lines = read_bytes(path, "the log of a training run").decode(errors="replace").split("\n")
    entries = []
    for number, line in enumerate(lines, start=1):
        entry = _entry(line)
        if entry is not None:
            entries.append(entry)
        elif number < len(lines):  # every line that was written whole has an end, and something behind it
            raise_input_error(
                path, f"line {number} is none of a training log", "move the file away, or choose another --out"
            )
    return entries


def _entry(line: str) -> dict[str, Any] | None:
    """What a line of a log says; None if it is no line of a log."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(entry, dict) or type(entry.get("step")) is not int:
        return None
    numbers = (value for value in entry.values() if value is not None)
    return entry if all(type(value) is int or isinstance(value, float) for value in numbers) else None


def _curve(name: str, points: np.ndarray) -> np.ndarray:
    """One panel [height, width, 3]: points [count, 2] of step and value, the value on a logarithmic scale."""
    height, width = CURVES_SIZE
    panel = np.full((height, width, 3), 255, np.uint8)
    steps, values = points[:, 0], np.log10(np.maximum(points[:, 1], 1e-9))
    span = max(1, round(SMOOTHED_OVER * len(values)))
    smooth = np.convolve(np.pad(values, (span - 1, 0), mode="edge"), np.ones(span) / span, mode="valid")
    low, high = values.min(), max(values.max(), values.min() + 0.01)
    x = MARGIN + (width - 2 * MARGIN) * steps / max(steps[-1], 1)
    for series, colour, thickness in ((values, FAINT, 1), (smooth, LINE, 2)):
        y = height - MARGIN - (height - 2 * MARGIN) * (series - low) / (high - low)
        line = np.stack([x, y], axis=-1).round().astype(np.int32)
        cv2.polylines(panel, [line[:, None]], False, colour, thickness, cv2.LINE_AA)
    cv2.rectangle(panel, (MARGIN, MARGIN), (width - MARGIN, height - MARGIN), INK, 1)
    _label(panel, f"{name}: {10 ** smooth[-1]:.4g}", (MARGIN, MARGIN - 15))
    _label(panel, f"{10**high:.3g}", (5, MARGIN + 5))
    _label(panel, f"{10**low:.3g}", (5, height - MARGIN))
    _label(panel, f"step {int(steps[-1])}", (width - MARGIN - 90, height - MARGIN + 25))
    return panel


def _label(panel: np.ndarray, text: str, place: tuple[int, int]) -> None:
    cv2.putText(panel, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)


def strip(image: np.ndarray, truth: np.ndarray | None, predicted: np.ndarray) -> np.ndarray:
    """Photograph, true and predicted inverse depth in the same colours, relative error; [H, 4 * W, 3] BGR bytes.

    image: RGB in [0, 1], [3, H, W]. truth, predicted: inverse depth, [H, W]; without truth only the prediction follows.
    """
    low, high = np.quantile(predicted if truth is None else truth, (0.01, 0.99))
    maps = [predicted] if truth is None else [truth, predicted]
    shown = [colours((x - low) / max(high - low, 1e-9), cv2.COLORMAP_TURBO) for x in maps]
    if truth is None:
        return np.concatenate([picture(image), *shown], axis=1)
    error = np.abs(truth / np.maximum(predicted, 1e-9) - 1) / WORST_ERROR
    return np.concatenate([picture(image), *shown, colours(error, cv2.COLORMAP_INFERNO)], axis=1)


def picture(image: np.ndarray) -> np.ndarray:
    """RGB in [0, 1], [3, H, W] -> BGR bytes [H, W, 3]."""
    return (image[::-1].transpose(1, 2, 0).clip(0, 1) * 255).round().astype(np.uint8)


def colours(values: np.ndarray, map_: int) -> np.ndarray:
    """Values, of which [0, 1] is shown, [H, W] -> BGR bytes [H, W, 3]."""
    return cv2.applyColorMap((values.clip(0, 1) * 255).astype(np.uint8), map_)


def write_rows(path: Path, rows: list[np.ndarray]) -> None:
    """Write pictures one below the other, with white where one is narrower than the widest."""
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    _write(path, np.concatenate(padded))


def _write(path: Path, bgr: np.ndarray) -> None:
    with atomic_write(path) as temporary:
        cv2.imwrite(str(temporary), bgr)


def finite(value: float) -> float | None:
    """A number that JSON knows, or None."""
    return round(value, 6) if math.isfinite(value) else None
