"""The words by which a command is told how depth maps are to be written."""

from enum import StrEnum


class DepthFormat(StrEnum):
    """npz: a picture and a NumPy archive for each view (`depth_maps`). colmap: a dense workspace."""

    NPZ = "npz"
    COLMAP = "colmap"
