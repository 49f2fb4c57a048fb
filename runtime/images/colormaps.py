"""Color maps for depth, and conversions of color values."""

import numpy as np

NEAREST_SHARE, FARTHEST_SHARE = 98, 2  # percentiles of inverse depth that get the ends of the colour map


def colormap_depth(depth: np.ndarray, limits: tuple[float, float] | None = None) -> np.ndarray:
    """Depth in world units, [height, width], as RGB in [0, 1] from blue (far) to red (near), by inverse depth.

    limits: vmin (blue) and vmax (red) of inverse depth, by default `inverse_depth_range` of this map; values beyond
    are clipped. Depth that is not positive and finite becomes black.
    """
    import cv2

    known = _known(depth)
    inverse_depth = 1 / np.where(known, depth, 1)
    vmin, vmax = inverse_depth_range(depth) if limits is None else limits
    t = (inverse_depth - vmin) / (vmax - vmin) if vmax > vmin else np.full(depth.shape, 0.5)
    bgr = cv2.applyColorMap(to_uint8(t), cv2.COLORMAP_TURBO)
    bgr[~known] = 0
    return bgr[..., ::-1].astype(np.float32) / 255


def inverse_depth_range(depth: np.ndarray) -> tuple[float, float]:
    """Inverse depths, of the far and the near end, beyond which 2 % of a depth map lie each."""
    known = _known(depth)
    far, near = np.percentile(1 / depth[known], (FARTHEST_SHARE, NEAREST_SHARE)) if known.any() else (0.0, 1.0)
    return float(far), float(near)


def _known(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def to_uint8(values: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] as uint8, rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def srgb_to_linear(colours: np.ndarray) -> np.ndarray:
    """Linear light, as glTF has it, for sRGB colours, as pictures have them; both in [0, 1], which is clipped to."""
    clipped = np.clip(colours, 0, 1)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4)
