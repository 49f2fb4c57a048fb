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


def depth_colours(depth: np.ndarray, ends: tuple[float, float] | None = None) -> np.ndarray:
    """Depth in world units, [height, width], as RGB in [0, 1] from blue (far) to red (near), by inverse depth.

    ends: the inverse depths that are quite blue and quite red; the map's own `depth_ends` if not given. What lies
    beyond has their colours. Depth that is not positive and finite becomes black.
    """
    import cv2

    known = _known(depth)
    inverse_depth = 1 / np.where(known, depth, 1)
    far, near = depth_ends(depth) if ends is None else ends
    warmth = (inverse_depth - far) / (near - far) if near > far else np.full(depth.shape, 0.5)
    picture = cv2.applyColorMap(to_bytes(warmth), cv2.COLORMAP_TURBO)
    picture[~known] = 0
    return picture[..., ::-1].astype(np.float32) / 255


def depth_ends(depth: np.ndarray) -> tuple[float, float]:
    """Inverse depths, of the far and the near end, beyond which 2 % of a depth map lie each."""
    known = _known(depth)
    far, near = np.percentile(1 / depth[known], (FARTHEST_SHARE, NEAREST_SHARE)) if known.any() else (0.0, 1.0)
    return float(far), float(near)


def _known(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] as uint8, rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def linear_colours(colours: np.ndarray) -> np.ndarray:
    """Linear light, as glTF has it, for sRGB colours, as pictures have them; both in [0, 1], which is clipped to."""
    clipped = np.clip(colours, 0, 1)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4)
