"""The Gaussians: what the model predicts, the files hold and the rasteriser draws."""

from dataclasses import dataclass, fields
from math import isqrt
from pathlib import Path

import numpy as np

from ..errors import InputError, raise_input_error
from ..geometry.sh import SH_0

FLOAT32_BYTES, WITHOUT_SH = 4, 11  # numbers of a Gaussian beside its spherical harmonics


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
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise InputError(f"Gaussians: sh has {self.sh.shape[1]} coefficients, expected 1, 4, 9 or 16")

    def __len__(self) -> int:
        return len(self.means)

    def select(self, index: np.ndarray) -> "Gaussians":
        """Some of the Gaussians: those that a mask keeps, or these, in this order."""
        return Gaussians(*(getattr(self, field.name)[index] for field in fields(self)))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return isqrt(self.sh.shape[1]) - 1

    @property
    def colours(self) -> np.ndarray:
        """Red, green and blue without the part that changes with the direction, usually in [0, 1], [gaussians, 3]."""
        return 0.5 + np.float32(SH_0) * self.sh[:, 0]


def bytes_in_memory(count: int, sh_degree: int) -> int:
    """What so many Gaussians of this degree take."""
    return count * FLOAT32_BYTES * (WITHOUT_SH + 3 * (sh_degree + 1) ** 2)


def check_ranges(path: Path, gaussians: Gaussians) -> None:
    """Raise InputError for values in a file's units instead of ours, before they are written to it."""
    if (gaussians.scales < 0).any():
        raise InputError(f"cannot write {path}: scales holds negative values; pass standard deviations, not logarithms")
    if ((gaussians.opacities < 0) | (gaussians.opacities > 1)).any():
        raise InputError(f"cannot write {path}: opacities holds values outside [0, 1]; pass opacities, not logits")


def check_finite(path: Path, gaussians: Gaussians) -> None:
    """Raise InputError for the first value, on its way to or from a file, that is not finite."""
    for field in fields(gaussians):
        finite = np.isfinite(getattr(gaussians, field.name))
        if not finite.all():
            at = int(np.argwhere(~finite)[0, 0])
            raise_input_error(path, f"{field.name} of Gaussian {at} is not a finite number", "leave that Gaussian out")


def with_colours(
    means: np.ndarray, scales: np.ndarray, quats: np.ndarray, opacities: np.ndarray, colours: np.ndarray
) -> Gaussians:
    """Gaussians of the same colour [gaussians, 3] from all sides, as float32 arrays."""
    sh = (colours[:, None] - 0.5) / SH_0
    return Gaussians(*(np.ascontiguousarray(array, np.float32) for array in (means, scales, quats, opacities, sh)))
