"""What idesplat-infer did, as one HTML page to look at: photographs, depth, confidence, and what the splats show."""

import base64
import html
from collections.abc import Iterator, Sequence
from pathlib import Path
from string import Template
from typing import Any

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

JPEG_QUALITY = 92
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 76rem; margin: 2rem auto; padding: 0 1rem }
h1, h2, h3 { line-height: 1.2; overflow-wrap: anywhere }
section > div { display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: 1rem }
figure { margin: 0 }
img { width: 100%; display: block; background: #eee }
figcaption { font-size: .875rem; color: #555 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { text-align: left; vertical-align: top; padding: .15rem 1.5rem .15rem 0; border-bottom: 1px solid #ddd }
th { font-weight: normal; color: #555; white-space: nowrap }
td { overflow-wrap: anywhere; white-space: pre-wrap }
</style>
</head>
<body>
<h1>$title</h1>
<p>$result</p>
$notes
<h2>Views</h2>
<p>Depth is blue at $far and beyond, red at $nearest and before, in the cameras' unit, in all views. Confidence is
the share of the other views that confirm a pixel's depth to 5 %, from dark (none) to yellow (all, or none can tell).
PSNR compares what the Gaussians show with the photograph, at the size at which the network saw it.</p>
$views
<h2>Seconds</h2>
$seconds
<h2>Settings</h2>
$settings
</body>
</html>
""")


def write_report(
    path: Path, depth: np.ndarray, gaussians: Gaussians, views: ViewBatch, summary: dict[str, Any]
) -> None:
    """Write one HTML file that needs nothing else.

    depth: z-depth in scene units, [views, height, width]. gaussians: as they were written, so perhaps cleaned.
    summary: the content of the JSON summary. Raises InputError if the file cannot be written.
    """
    shown = dict(summary)
    seconds, notes, files = shown.pop("seconds"), shown.pop("notes"), shown.pop("files")
    far, near = inverse_depth_range(depth)
    count = f"{len(views.names)} photographs became {len(gaussians):,} Gaussians."
    page = PAGE.substitute(
        title=html.escape(f"idesplat: {Path(files[0]).name}"),
        result=html.escape(count),
        notes="".join(f"<p>{html.escape(note)}</p>\n" for note in notes),
        far=f"{1 / far:.4g}",
        nearest=f"{1 / near:.4g}",
        views="\n".join(_sections(depth, gaussians, views, (far, near))),
        seconds=_table([(name, f"{value:.2f}") for name, value in seconds.items()]),
        settings=_table([*_flat(shown), ("files", "\n".join(files))]),
    )
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")


def _sections(depth: np.ndarray, gaussians: Gaussians, views: ViewBatch, ends: tuple[float, float]) -> Iterator[str]:
    """For each view its photograph, what the splats show from there, depth and confidence."""
    height, width = depth.shape[1:]
    points = points_from_depth(depth, views.images, views.extrinsics, views.intrinsics).positions
    confirmed = multi_view_consistency(points.reshape(*depth.shape, 3), depth, views.extrinsics, views.intrinsics)
    Ks = denormalize_intrinsics(views.intrinsics, width, height)  # [views, 3, 3]
    for index in progress(range(len(depth)), "drawing the report"):
        photograph = to_uint8(views.images[index].transpose(1, 2, 0))
        drawn = to_uint8(render_view(gaussians, views.extrinsics[index], Ks[index], width, height).rgb)
        low, middle, high = np.percentile(depth[index], (0, 50, 100))
        colours = cv2.applyColorMap(to_uint8(confirmed[index]), cv2.COLORMAP_VIRIDIS)[..., ::-1]
        figures = [
            _figure(photograph, f"photograph, {width}x{height}", ".jpg"),
            _figure(drawn, f"drawn from the Gaussians: PSNR {cv2.PSNR(photograph, drawn):.2f} dB", ".jpg"),
            _figure(
                to_uint8(colormap_depth(depth[index], ends)), f"depth {low:.4g} to {high:.4g}, median {middle:.4g}"
            ),
            _figure(colours, f"confidence, mean {100 * confirmed[index].mean():.0f} %"),
        ]
        yield f"<section>\n<h3>{html.escape(views.names[index])}</h3>\n<div>{''.join(figures)}</div>\n</section>"


def _figure(picture: np.ndarray, caption: str, suffix: str = ".png") -> str:
    """RGB, uint8 [height, width, 3], with words below it."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix == ".jpg" else []
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(picture[..., ::-1]), quality)
    kind = "jpeg" if suffix == ".jpg" else "png"
    data = base64.b64encode(encoded.data).decode("ascii")
    words = html.escape(caption)
    return f'<figure><img alt="{words}" src="data:image/{kind};base64,{data}"><figcaption>{words}</figcaption></figure>'


def _flat(settings: dict[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of settings within settings, in words."""
    for name, value in settings.items():
        label = f"{before}{name}".replace("_", " ")
        if isinstance(value, dict):
            yield from _flat(value, f"{label}: ")
        elif isinstance(value, float):
            yield label, f"{value:.6g}"
        else:
            yield label, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{''.join(cells)}</table>"
