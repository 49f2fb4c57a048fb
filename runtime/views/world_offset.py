"""World coordinates that float32 does not hold: found out, and brought near the origin by an offset that is recorded.

Splat files hold means in float32, whose steps grow with the distance from the origin: 8 mm at 100 km in metres, half a
metre where a survey counts northings in millions. A scene there is written relative to an offset, and the file says so,
where it can. The cameras of a scene stay in the user's own world; who uses both subtracts the offset from them.
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
# Of the smallest splats' size: as much may float32 move a mean without being seen. A splat of a pixel at the near plane
# is taken for the smallest.
LARGEST_STEP = 0.25
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
    """How far apart float32 can place means where these cameras stand, in world units."""
    return float(np.spacing(np.float32(np.abs(views.extrinsics[:, :3, 3]).max())))


def loses_precision(views: "ViewBatch", near: float) -> bool:
    """Whether float32 moves means visibly; near: the nearest depth, in world units."""
    focal = (views.intrinsics[:, [0, 1], [0, 1]] * views.images.shape[:1:-1]).max()  # pixels
    return float32_step(views) > LARGEST_STEP * near / float(focal)


def offset_views(views: "ViewBatch", offset: np.ndarray) -> "ViewBatch":
    """The views in a world whose origin is at `offset` [3] of theirs."""
    extrinsics = views.extrinsics.astype(np.float64)
    extrinsics[:, :3, 3] -= offset
    return replace(
        views,
        extrinsics=extrinsics,
        cameras=offset_cameras(views.cameras, offset),
        offset=views.offset + offset,
    )


def apply_offset(views: "ViewBatch", text: str | None, near: float) -> "tuple[ViewBatch, list[str]]":
    """The views relative to what --offset asks for, and lines for the user: what was done, or should be.

    near: the nearest depth, in world units. Raises InputError as `parse_offset`.
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
    """An offset [3] as --offset takes it, every digit of it."""
    return ",".join(f"{value:.17g}" if value != round(value) else f"{value:.0f}" for value in offset.tolist())


def _middle(views: "ViewBatch", near: float) -> np.ndarray:
    """The middle of the cameras, rounded to the power of ten that is as large as the scene."""
    positions = views.extrinsics[:, :3, 3].astype(np.float64)
    extent = max(near, float(np.ptp(positions, axis=0).max()))
    unit = 10.0 ** np.ceil(np.log10(extent))
    return np.rint(positions.mean(axis=0) / unit) * unit
