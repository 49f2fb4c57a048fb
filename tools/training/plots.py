"""Images that a training run writes: curves of its log, and predictions beside the truth."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...runtime.images.colormaps import to_uint8
from ...runtime.system.files import atomic_write

# Size of one curve's plot, in inches at DPI dots per inch.
PLOT_WIDTH, PLOT_HEIGHT, DPI = 9.0, 3.6, 100
# Window of the running mean over a curve, as a share of its points.
SMOOTHING = 0.02
# The relative error that is shown with the brightest colour.
MAX_ERROR = 0.3
# Percentiles of inverse depth that get the ends of the colour map.
DEPTH_QUANTILES = 0.01, 0.99


def write_curves(path: Path, entries: Sequence[dict[str, Any]], names: Iterable[str]) -> None:
    """Write a PNG with one plot for each of `names` that has been logged: values over steps, and their running mean.

    Values are on a logarithmic scale; the titles show the last running mean.
    """
    from matplotlib.figure import Figure

    curves = {name: [(e["step"], e[name]) for e in entries if e.get(name) is not None] for name in names}
    curves = {name: points for name, points in curves.items() if points}
    if not curves:
        return
    figure = Figure(figsize=(PLOT_WIDTH, PLOT_HEIGHT * len(curves)), dpi=DPI, layout="constrained")
    plots = figure.subplots(len(curves), squeeze=False)[:, 0]
    for plot, (name, points) in zip(plots, curves.items(), strict=True):
        steps, values = np.array(points, float).T
        smooth = running_mean(values)
        plot.semilogy(steps, np.maximum(values, 1e-9), color="0.8", linewidth=0.8)
        plot.semilogy(steps, smooth, color="tab:blue", linewidth=1.5)
        plot.set_title(f"{name}: {smooth[-1]:.4g}", loc="left")
        plot.set_xlabel("step")
        plot.grid(which="both", color="0.93")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")


def running_mean(values: np.ndarray) -> np.ndarray:
    """The geometric running mean of a curve [points], over the preceding points."""
    logarithms = np.log10(np.maximum(values, 1e-9))
    window = max(1, round(SMOOTHING * len(values)))
    padded = np.pad(logarithms, (window - 1, 0), mode="edge")
    return 10 ** np.convolve(padded, np.ones(window) / window, mode="valid")


def compare_depth(image: np.ndarray, truth: np.ndarray | None, predicted: np.ndarray) -> np.ndarray:
    """Image, true and predicted inverse depth in the same colours, and relative error, [H, 4 * W, 3] uint8 BGR.

    image: RGB in [0, 1], [3, H, W]. truth, predicted: inverse depth, [H, W]; without truth only the prediction follows.
    """
    low, high = np.quantile(predicted if truth is None else truth, DEPTH_QUANTILES)
    maps = [predicted] if truth is None else [truth, predicted]
    parts = [to_bgr(image)]
    parts += [colormap((values - low) / max(high - low, 1e-9), cv2.COLORMAP_TURBO) for values in maps]
    if truth is not None:
        error = np.abs(truth / np.maximum(predicted, 1e-9) - 1) / MAX_ERROR
        parts.append(colormap(error, cv2.COLORMAP_INFERNO))
    return np.concatenate(parts, axis=1)


def to_bgr(image: np.ndarray) -> np.ndarray:
    """RGB in [0, 1], [3, H, W] -> uint8 BGR [H, W, 3]."""
    return to_uint8(image[::-1].transpose(1, 2, 0))


def colormap(values: np.ndarray, map_: int) -> np.ndarray:
    """Values in [0, 1], [H, W], clipped -> uint8 BGR [H, W, 3]. map_: one of OpenCV's colour maps."""
    return cv2.applyColorMap((values.clip(0, 1) * 255).astype(np.uint8), map_)


def write_rows(path: Path, rows: Sequence[np.ndarray]) -> None:
    """Write images [H, W, 3] one below the other; narrower ones are padded with white."""
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    with atomic_write(path) as temporary:
        cv2.imwrite(str(temporary), np.concatenate(padded))
