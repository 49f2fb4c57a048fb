"""The form fields of a request: the options of `idesplat infer` by their names, with `_` for `-`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..batch.scenes import OPTIONS, check_options, parse_option
from ..cameras.formats import CameraFormat
from ..errors import InputError, error_context
from ..inference.inputs import ALL, select_images
from ..reconstruction.quality import PRESETS, Quality
from ..views.exposure_mode import ExposureMode
from .limits import Limits, Refused

MAX_TEXT = 2000  # characters of a field
FLAG, NUMBER, COUNT, TEXT = "boolean", "number", "integer", "string"


class Field(NamedTuple):
    """One form field for the API's description. kind: its JSON type. choices: all values, where these are few."""

    kind: str
    description: str
    example: Any
    choices: tuple[str, ...] = ()


FIELDS: dict[str, Field] = {
    "quality": Field(
        TEXT,
        "fast: two images, as the network predicts them. standard: eight, fused and refined. high: 24, larger, with "
        "more steps.",
        "fast",
        tuple(Quality),
    ),
    "camera_format": Field(
        TEXT, "Format of the cameras, where their content does not tell it.", "colmap", tuple(CameraFormat)
    ),
    "focal": Field(TEXT, "For estimated cameras: focal length in pixels, or on 35 mm film such as 26mm.", "26mm"),
    "select": Field(TEXT, "Images to use: names, numbers from 0, 0-3 or 0:8:2, with commas between.", "0,2"),
    "views": Field(TEXT, "How many images to use, those with the best baselines, or all.", "4"),
    "size": Field(TEXT, "HEIGHTxWIDTH to work at; else by the trained size.", "256x448"),
    "crop": Field(FLAG, "Use the middle of the images at the model's trained size.", False),
    "refine": Field(TEXT, "Steps of refinement on the images, or its time such as 30s; 0 for none.", "30s"),
    "max_gaussians": Field(COUNT, "Keep at most so many Gaussians, those that contribute most; 0: all.", 100000),
    "near": Field(NUMBER, "Nearest depth in scene units; found where not given.", 0.5),
    "far": Field(NUMBER, "Farthest depth in scene units; found where not given.", 50.0),
    "offset": Field(TEXT, "Write coordinates relative to this: auto, or X,Y,Z.", "auto"),
    "exposure": Field(
        TEXT,
        "Bring images of differing exposure and white balance to a common one, or leave them.",
        "auto",
        tuple(ExposureMode),
    ),
    "min_opacity": Field(NUMBER, "Leave out Gaussians of lower opacity, 0 to 1.", 0.05),
    "crop_border": Field(COUNT, "Leave out this many pixels along every image's edges.", 4),
    "max_depth_jump": Field(
        NUMBER, "Leave out pixels whose depth differs from a neighbour's by more than this share.", 0.05
    ),
    "min_consistency": Field(NUMBER, "Leave out pixels whose depth a smaller share of the other views confirms.", 0.5),
    "remove_contradicted": Field(FLAG, "Leave out what other views see through, with three views or more.", False),
    "merge_duplicates": Field(FLAG, "Make one Gaussian of those that views put at the same place.", False),
    "close_holes": Field(FLAG, "Fit the shapes to the surface, and continue the background behind edges.", False),
}


def parse_options(texts: Mapping[str, str], default: Quality, images: Sequence[Path], limits: Limits) -> dict[str, Any]:
    """The options of `reconstruct` and `FilterOptions` in form fields; empty fields count as absent.

    default: the quality where none is asked for. images: their files.
    Raises InputError for an unknown field or an invalid value, Refused for what is beyond the limits.
    """
    options = {}
    for name, text in texts.items():
        if name not in OPTIONS:
            raise InputError(f"unknown field {name[:40]!r}; expected images, cameras, {', '.join(OPTIONS)}")
        if len(text) > MAX_TEXT:
            raise InputError(f"{name}: {len(text)} characters, expected {MAX_TEXT} at most")
        if text:
            options[name] = _parse_field(name, text)
    check_options(options)  # before anything is queued
    _check_limits(options, default, images, limits)
    return options


def _parse_field(name: str, text: str) -> Any:
    with error_context(f"{name} {text[:40]!r}"):
        value = parse_option(name, text)
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError("expected a finite number")
        return value


def _check_limits(options: Mapping[str, Any], default: Quality, images: Sequence[Path], limits: Limits) -> None:
    """Raise Refused for more views or pixels than the service takes."""
    preset = PRESETS[options.get("quality") or default]
    count = len(select_images(images, options.get("select")))
    asked = options.get("views") or (ALL if options.get("select") else preset.views)
    views = count if asked == ALL else min(int(asked), count)
    if views > limits.views:
        raise Refused(413, f"{views} views, expected {limits.views} at most; give `views` or fewer images")
    height, width = options.get("size") or (0, 0)
    if height * width > limits.size[0] * limits.size[1]:
        largest = "{}x{}".format(*limits.size)
        raise Refused(413, f"size {height}x{width}: expected no more pixels than {largest} has")
