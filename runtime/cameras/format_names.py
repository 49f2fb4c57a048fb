"""The words by which a command is told what its cameras are."""

from enum import StrEnum

ESTIMATE = "estimate"  # in the place of a file of cameras: find them from the photographs


class CameraFormat(StrEnum):
    """The formats of camera files; each is read by the module `cameras_<value>`."""

    OWN = "own"
    TRANSFORMS = "transforms"
    COLMAP = "colmap"
    RE10K = "re10k"
    LLFF = "llff"
    DTU = "dtu"
    OPENCV = "opencv"


COLMAP_PARTS = ("cameras", "images", "frames", "rigs", "points3D")
