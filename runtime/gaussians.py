"""The Gaussians: what the model predicts, the files hold and the rasteriser draws."""

from dataclasses import dataclass
from math import isqrt

import numpy as np

from .errors import InputError


@dataclass(frozen=True)
class Gaussians:
    """A set of 3D Gaussians in the world frame, in gsplat's terms, all float32.

    means: centres in world units, [gaussians, 3].
    scales: standard deviations along the three axes in world units (not their logarithm), [gaussians, 3].
    quats: rotations of the axes to the world, wxyz, [gaussians, 4].
    opacities: in [0, 1] (not logits), [gaussians].
    sh: spherical harmonics in the basis of 3DGS, [gaussians, (degree + 1)^2, 3].
    """

    means: np.ndarray
    scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.means)
        expected = {"means": (count, 3), "scales": (count, 3), "quats": (count, 4), "opacities": (count,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"Gaussians: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != count or self.sh.shape[2] != 3:
            raise InputError(f"Gaussians: sh has shape {self.sh.shape}, expected ({count}, coefficients, 3)")
        if isqrt(self.sh.shape[1]) ** 2 != self.sh.shape[1]:
            raise InputError(f"Gaussians: sh has {self.sh.shape[1]} coefficients, expected 1, 4, 9 or 16")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return isqrt(self.sh.shape[1]) - 1
