"""Pictures out: colours and depth as 8-bit PNG files that appear whole or not at all."""

from pathlib import Path

import numpy as np

from ..system.files import replacing

NEAREST_SHARE, FARTHEST_SHARE = 98, 2  # percentiles of inverse depth that get the ends of the colour map


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write colours in [0, 1], [height, width, 3], as an 8-bit PNG; what lies outside is clipped.

    Raises InputError if the file cannot be written.
    """
    import cv2  # here, so that a command can say what it does without loading OpenCV

    _, encoded = cv2.imencode(".png", to_bytes(rgb)[..., ::-1])
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.data)


def save_depth_png(path: Path, depth: np.ndarray) -> None:
    """Write depth in world units, [height, width], in the colours of `depth_colours`.

    Raises InputError if the file cannot be written.
    """
    save_png(path, depth_colours(depth))


def depth_colours(depth: np.ndarray, limits: tuple[float, float] | None = None) -> np.ndarray:
    """Depth in world units, [height, width], as RGB in [0, 1] from blue (far) to red (near), linear in inverse depth.

    limits: vmin and vmax, the inverse depths at the blue and the red end of the colour map; the map's own
    `inverse_depth_range` by default. Values beyond them are clipped. Depth that is not positive and finite is black.
    """
    import cv2

    known = _known(depth)
    inverse_depth = 1 / np.where(known, depth, 1)
    vmin, vmax = inverse_depth_range(depth) if limits is None else limits
    t = (inverse_depth - vmin) / (vmax - vmin) if vmax > vmin else np.full(depth.shape, 0.5)
    picture = cv2.applyColorMap(to_bytes(t), cv2.COLORMAP_TURBO)
    picture[~known] = 0
    return picture[..., ::-1].astype(np.float32) / 255


def inverse_depth_range(depth: np.ndarray) -> tuple[float, float]:
    """vmin and vmax of a depth map's colours: the 2nd and the 98th percentile of its inverse depth."""
    known = _known(depth)
    vmin, vmax = np.percentile(1 / depth[known], (FARTHEST_SHARE, NEAREST_SHARE)) if known.any() else (0.0, 1.0)
    return float(vmin), float(vmax)


def _known(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] as uint8, rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def linear_colours(colours: np.ndarray) -> np.ndarray:
    """Linear light, as glTF has it, for sRGB colours, as pictures have them; both in [0, 1], which is clipped to."""
    clipped = np.clip(colours, 0, 1)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4)
