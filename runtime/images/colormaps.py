"""Colour maps for depth, and conversions of colour values."""

import numpy as np

VMIN_PERCENTILE, VMAX_PERCENTILE = 2, 98  # of inverse depth


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
    """vmin and vmax of a depth map's colours: the 2nd and 98th percentile of inverse depth; (0, 1) without depth."""
    known = _known(depth)
    vmin, vmax = np.percentile(1 / depth[known], (VMIN_PERCENTILE, VMAX_PERCENTILE)) if known.any() else (0.0, 1.0)
    return float(vmin), float(vmax)


def _known(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def to_uint8(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] as uint8, clipped and rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def srgb_to_linear(colours: np.ndarray) -> np.ndarray:
    """Linear RGB of sRGB colours (IEC 61966-2-1), both in [0, 1]; values outside are clipped."""
    clipped = np.clip(colours, 0, 1)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4)
