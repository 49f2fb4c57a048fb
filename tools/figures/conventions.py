"""The figures of docs/conventions.md: axes, pixel centres, extrinsics and the order of SH coefficients, as SVG.

python -P -m idesplat.tools.figures.conventions docs/images
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from ...runtime.cli.terminal import run
from ...runtime.geometry.sh import sh_basis
from ...runtime.system.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}
# Where x, y and z point on the page in an oblique view: right, down, and up to the right for what points away.
RIGHT, DOWN, FORWARD = np.array([1.0, 0.0]), np.array([0.0, -1.0]), np.array([0.55, 0.5])
FRAMES = {
    "OpenCV, COLMAP, 3DGS .ply\nx right, y down, z forward": (RIGHT, DOWN, FORWARD),
    "OpenGL, transforms.json, .spz\nx right, y up, z backward": (RIGHT, -DOWN, -FORWARD),
    "glTF (.glb)\nx left, y up, z forward": (-RIGHT, -DOWN, FORWARD),
}
SH_PIXELS = 96
SH_DEGREES = 4  # 0 to 3


def plot_axes() -> "Figure":
    """The camera axes of the file formats, seen from behind the camera and a little above."""
    figure, panels = _panels(1, len(FRAMES), (9.0, 3.0))
    for panel, (title, directions) in zip(panels, FRAMES.items(), strict=True):
        panel.set(title=title, xlim=(-1.5, 1.5), ylim=(-1.3, 1.3), aspect="equal")
        panel.title.set_fontsize(9)
        panel.axis("off")
        for name, tip in zip("xyz", directions, strict=True):
            _arrow(panel, np.zeros(2), tip, COLOURS[name])
            _label(panel, tip * 1.18, name, color=COLOURS[name], ha="center", va="center", fontsize=12)
        panel.plot(0, 0, "o", color="black", markersize=4)
    return figure


def plot_pixels() -> "Figure":
    """Pixel coordinates of an image of 4 x 3 pixels, and the same normalized by width and height."""
    width, height = 4, 3
    figure, (panel,) = _panels(1, 1, (5.2, 4.0))
    panel.set(xlim=(-0.7, width + 0.7), ylim=(height + 0.9, -0.9), aspect="equal")
    panel.axis("off")
    for x in range(width + 1):
        panel.plot([x, x], [0, height], color="0.6", linewidth=0.8)
        panel.text(x, -0.12, f"{x}", ha="center", va="bottom", fontsize=9)
        panel.text(x, height + 0.12, f"{x / width:g}", ha="center", va="top", fontsize=9, color="#9467bd")
    for y in range(height + 1):
        panel.plot([0, width], [y, y], color="0.6", linewidth=0.8)
        panel.text(-0.12, y, f"{y}", ha="right", va="center", fontsize=9)
        panel.text(width + 0.12, y, f"{y / height:.3g}", ha="left", va="center", fontsize=9, color="#9467bd")
    xs, ys = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    panel.plot(xs, ys, ".", color="black", markersize=4)
    panel.annotate(
        "first pixel's centre: (0.5, 0.5)", (0.5, 0.5), (0.62, 0.9), fontsize=9, arrowprops={"arrowstyle": "->"}
    )
    panel.text(width / 2, -0.6, "pixels (Camera.K)", ha="center", fontsize=9)
    panel.text(
        width / 2, height + 0.65, "normalized (the graph's intrinsics)", ha="center", fontsize=9, color="#9467bd"
    )
    return figure


def plot_extrinsics() -> "Figure":
    """Camera-to-world and world-to-camera, and z-depth beside the distance along the ray, seen from above."""
    figure, (panel,) = _panels(1, 1, (7.0, 3.6))
    panel.set(xlim=(-0.8, 9.6), ylim=(-0.9, 4.4), aspect="equal")
    panel.axis("off")
    _arrow(panel, np.zeros(2), np.array([1.0, 0.0]), COLOURS["x"])
    _arrow(panel, np.zeros(2), np.array([0.0, 1.0]), COLOURS["z"])
    panel.text(-0.1, -0.35, "world", ha="center", fontsize=10)

    centre, point, angle = np.array([5.2, 0.9]), np.array([7.4, 4.1]), np.radians(20)
    right = np.array([np.cos(angle), np.sin(angle)])
    forward = np.array([-np.sin(angle), np.cos(angle)])
    _arrow(panel, centre, centre + right, COLOURS["x"])
    _arrow(panel, centre, centre + forward, COLOURS["z"])
    _label(panel, centre + 1.12 * right, "x", color=COLOURS["x"], va="center")
    _label(panel, centre + 1.12 * forward, "z", color=COLOURS["z"], ha="center")
    panel.text(centre[0] + 0.3, centre[1] - 0.45, "camera (y points into the page)", fontsize=10)

    for start, end, bend, label, height in (
        (centre, np.zeros(2), 0.25, "extrinsics: camera-to-world", 1.75),
        (np.zeros(2), centre, 0.22, "viewmat: world-to-camera", -0.8),
    ):
        style = {"arrowstyle": "->", "connectionstyle": f"arc3,rad={bend}", "shrinkA": 8, "shrinkB": 8, "color": "0.3"}
        panel.annotate("", _pair(end), _pair(start), arrowprops=style)
        panel.text(2.3, height, label, ha="center", fontsize=10)

    foot = centre + forward * float((point - centre) @ forward)
    panel.plot([centre[0], point[0]], [centre[1], point[1]], color="0.4", linestyle="--", linewidth=1)
    panel.plot([centre[0], foot[0]], [centre[1], foot[1]], color=COLOURS["z"], linewidth=1)
    panel.plot([foot[0], point[0]], [foot[1], point[1]], color="0.7", linewidth=0.8)
    panel.plot(point[0], point[1], "o", color="black", markersize=4)
    _label(panel, (centre + foot) / 2 + (-0.2, 0.6), "z-depth", color=COLOURS["z"], ha="right", fontsize=10)
    _label(panel, (centre + point) / 2 + (0.2, -0.3), "distance along the ray (not used)", fontsize=9, color="0.4")
    return figure


def plot_sh_order() -> "Figure":
    """The 16 basis functions of degree 0 to 3 on a sphere seen along z (x right, y down), in the order of `sh`."""
    figure, panels = _panels(SH_DEGREES, 2 * SH_DEGREES - 1, (7.6, 4.8))
    span = np.linspace(-1.05, 1.05, SH_PIXELS)
    x, y = np.meshgrid(span, span)
    inside = x**2 + y**2 <= 1
    # The camera looks along z, so it sees the half of the sphere whose directions have a negative z.
    directions = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[inside]
    basis = sh_basis(directions, SH_DEGREES**2)
    for row in range(SH_DEGREES):
        for column in range(2 * SH_DEGREES - 1):
            panel = panels[row * (2 * SH_DEGREES - 1) + column]
            panel.axis("off")
            order = column - (SH_DEGREES - 1)
            if abs(order) > row:
                continue
            index = row * (row + 1) + order
            values = np.full(inside.shape, np.nan)
            values[inside] = basis[:, index]
            panel.imshow(values, cmap="RdBu_r", vmin=-0.75, vmax=0.75)
            panel.set_title(f"{index}", fontsize=9, pad=2)
    figure.text(0.02, 0.5, "degree 0 to 3", rotation=90, va="center", fontsize=10)
    figure.text(0.5, 0.01, "red: positive, blue: negative", ha="center", fontsize=9)
    return figure


FIGURES = {
    "axes.svg": plot_axes,
    "pixels.svg": plot_pixels,
    "extrinsics.svg": plot_extrinsics,
    "sh-order.svg": plot_sh_order,
}


def conventions(folder: Annotated[Path, typer.Argument(help="Folder for the figures.", show_default=False)]) -> None:
    """Write the figures of docs/conventions.md."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "idesplat"  # the same file from every run
    folder.mkdir(parents=True, exist_ok=True)
    for name, plot in FIGURES.items():
        buffer = io.BytesIO()
        plot().savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
        with atomic_write(folder / name) as temporary:
            temporary.write_bytes(buffer.getvalue())


def main() -> None:
    """Run the command."""
    run(conventions)


def _panels(rows: int, columns: int, size: tuple[float, float]) -> "tuple[Figure, list[Axes]]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def _pair(point: np.ndarray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _label(panel: "Axes", point: np.ndarray, text: str, **style: Any) -> None:
    panel.text(float(point[0]), float(point[1]), text, **style)


def _arrow(panel: "Axes", start: np.ndarray, end: np.ndarray, colour: str) -> None:
    panel.annotate("", _pair(end), _pair(start), arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2})


if __name__ == "__main__":
    main()
