"""The report of an inference as one HTML page: images, rendered views, depth and multi-view consistency.

The page is `templates/report.html.jinja`, with everything in it, and runs no script.
"""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..geometry.consistency import multi_view_consistency
from ..geometry.intrinsics import denormalize_intrinsics
from ..images.colormaps import colormap_depth, inverse_depth_range, to_uint8
from ..rendering.render import render_view
from ..splats.gaussians import Gaussians
from ..splats.points import points_from_depth
from ..system.files import atomic_write
from ..system.progress import progress
from ..views.batch import ViewBatch

TEMPLATES = Path(__file__).with_name("templates")
TEMPLATE = "report.html.jinja"
JPEG_QUALITY = 92


class Figure(NamedTuple):
    """An image as a data URL, and its caption."""

    url: str
    caption: str


class Section(NamedTuple):
    """The figures of one view."""

    name: str
    figures: list[Figure]


def write_report(
    path: Path, depth: np.ndarray, gaussians: Gaussians, views: ViewBatch, summary: dict[str, Any]
) -> None:
    """Write the report as one HTML file that needs no other file and no network.

    depth: z-depth in scene units, [views, height, width]. gaussians: as they were written, after filters.
    summary: the content of the JSON summary. Raises InputError if the file cannot be written.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    shown = dict(summary)
    seconds, notes, files = shown.pop("seconds"), shown.pop("notes"), shown.pop("files")
    vmin, vmax = inverse_depth_range(depth)
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = environment.get_template(TEMPLATE).render(
        title=f"idesplat: {Path(files[0]).name}",
        view_count=len(views.names),
        gaussian_count=f"{len(gaussians):,}",
        notes=notes,
        far=f"{1 / vmin:.4g}",
        near=f"{1 / vmax:.4g}",
        views=_sections(depth, gaussians, views, (vmin, vmax)),
        seconds=[(name, f"{value:.2f}") for name, value in seconds.items()],
        settings=[*_flat(shown), ("files", "\n".join(files))],
    )
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")


def _sections(
    depth: np.ndarray, gaussians: Gaussians, views: ViewBatch, limits: tuple[float, float]
) -> Iterator[Section]:
    """For each view its image, what the Gaussians show from there, depth and consistency.

    limits: inverse depths at the ends of the colour map.
    """
    height, width = depth.shape[1:]
    points = points_from_depth(depth, views.images, views.extrinsics, views.intrinsics).positions
    consistency = multi_view_consistency(points.reshape(*depth.shape, 3), depth, views.extrinsics, views.intrinsics)
    Ks = denormalize_intrinsics(views.intrinsics, width, height)
    for index in progress(range(len(depth)), "rendering the report"):
        image = to_uint8(views.images[index].transpose(1, 2, 0))
        rendered = to_uint8(render_view(gaussians, views.extrinsics[index], Ks[index], width, height).rgb)
        low, median, high = np.percentile(depth[index], (0, 50, 100))
        depth_map = to_uint8(colormap_depth(depth[index], limits))
        consistency_map = cv2.applyColorMap(to_uint8(consistency[index]), cv2.COLORMAP_VIRIDIS)[..., ::-1]
        yield Section(
            views.names[index],
            [
                Figure(_data_url(image, ".jpg"), f"image, {width}x{height}"),
                Figure(_data_url(rendered, ".jpg"), f"rendered Gaussians: PSNR {cv2.PSNR(image, rendered):.2f} dB"),
                Figure(_data_url(depth_map), f"depth {low:.4g} to {high:.4g}, median {median:.4g}"),
                Figure(_data_url(consistency_map), f"consistency, mean {100 * consistency[index].mean():.0f} %"),
            ],
        )


def _data_url(rgb: np.ndarray, suffix: str = ".png") -> str:
    """RGB, uint8 [height, width, 3], as a data URL of a PNG or JPEG."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix == ".jpg" else []
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(rgb[..., ::-1]), quality)
    kind = "jpeg" if suffix == ".jpg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(encoded.data).decode('ascii')}"


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of nested settings, as text."""
    for name, value in settings.items():
        label = f"{prefix}{name}".replace("_", " ")
        if isinstance(value, dict):
            yield from _flat(value, f"{label}: ")
        elif isinstance(value, float):
            yield label, f"{value:.6g}"
        else:
            yield label, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
