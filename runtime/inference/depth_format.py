"""The file formats of depth maps, by their names in options."""

from enum import StrEnum


class DepthFormat(StrEnum):
    """npz: a PNG and a NumPy archive for each view (`depth_maps`). colmap: a dense workspace (`colmap_workspace`)."""

    NPZ = "npz"
    COLMAP = "colmap"
