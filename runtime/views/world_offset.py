"""World offset: georeferenced coordinates that exceed the precision of float32.

Splat files store means in float32, whose spacing grows with the distance from the origin: 8 mm at 100 km in metres,
half a metre for northings in millions. Such a scene is written relative to an offset, which is recorded in formats that
can hold it. Camera files stay in the input's world frame; to use them with the scene, subtract the offset from them.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.camera import offset_cameras
from ..errors import InputError
from ..geometry.rigid import MAX_COORDINATE

if TYPE_CHECKING:
    from .batch import ViewBatch

AUTO = "auto"
# Largest invisible rounding of a mean, relative to the smallest splat, which is taken to be a pixel at the near plane.
MAX_STEP = 0.25
NO_OFFSET = np.zeros(3)


def parse_offset(text: str) -> np.ndarray | None:
    """The option --offset, `X,Y,Z` as float64 [3], or None for `auto`; raises InputError."""
    if text.strip().lower() == AUTO:
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not (np.abs(values) <= MAX_COORDINATE).all():
        raise InputError(
            f"--offset {text}: expected {AUTO}, or X,Y,Z in the cameras' unit, up to {MAX_COORDINATE:g} each"
        )
    return values


def float32_step(views: "ViewBatch") -> float:
    """The spacing of float32 at the largest camera coordinate, in world units."""
    return float(np.spacing(np.float32(np.abs(views.extrinsics[:, :3, 3]).max())))


def loses_precision(views: "ViewBatch", near: float) -> bool:
    """Whether float32 rounds means visibly. near: in world units."""
    focal = (views.intrinsics[:, [0, 1], [0, 1]] * views.images.shape[:1:-1]).max()  # pixels
    return float32_step(views) > MAX_STEP * near / float(focal)


def offset_views(views: "ViewBatch", offset: np.ndarray) -> "ViewBatch":
    """The views in a world frame whose origin is at `offset` [3] in the present one."""
    extrinsics = views.extrinsics.astype(np.float64)
    extrinsics[:, :3, 3] -= offset
    return replace(
        views,
        extrinsics=extrinsics,
        cameras=offset_cameras(views.cameras, offset),
        offset=views.offset + offset,
    )


def apply_offset(views: "ViewBatch", text: str | None, near: float) -> "tuple[ViewBatch, list[str]]":
    """The views relative to the offset in `text` (the option --offset), and notes for the user.

    near: in world units. Raises InputError as `parse_offset`.
    """
    notes = []
    if text is not None:
        offset = parse_offset(text)
        if offset is None:
            offset = _middle(views, near) if loses_precision(views, near) else NO_OFFSET
        views = offset_views(views, offset)
        notes.append(
            f"coordinates are relative to {offset_text(offset)}, which the results record where their formats can"
            if offset.any()
            else "no offset is needed: float32 holds these coordinates"
        )
    if loses_precision(views, near):
        largest = np.abs(views.extrinsics[:, :3, 3]).max()
        notes.append(
            f"warning: at coordinates of {largest:.4g}, float32 places splats in steps of {float32_step(views):.2g}, "
            "which is coarser than they are; give --offset auto, or --offset X,Y,Z, to write them relative to that"
        )
    return views, notes


def offset_text(offset: np.ndarray) -> str:
    """An offset [3] in the form of the option --offset, exactly."""
    return ",".join(f"{value:.17g}" if value != round(value) else f"{value:.0f}" for value in offset.tolist())


def _middle(views: "ViewBatch", near: float) -> np.ndarray:
    """The mean camera position, rounded to a multiple of the power of ten above the extent of the scene."""
    positions = views.extrinsics[:, :3, 3].astype(np.float64)
    extent = max(near, float(np.ptp(positions, axis=0).max()))
    unit = 10.0 ** np.ceil(np.log10(extent))
    return np.rint(positions.mean(axis=0) / unit) * unit
