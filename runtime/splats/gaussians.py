"""The set of 3D Gaussians that models predict, files hold and the rasteriser renders."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import isqrt
from pathlib import Path

import numpy as np

from ..errors import InputError, raise_input_error
from ..geometry.sh import SH_0

FLOAT32_BYTES = 4
VALUES_WITHOUT_SH = 11  # of a Gaussian: 3 means, 3 scales, 4 quats, 1 opacity


@dataclass(frozen=True)
class Gaussians:
    """A set of 3D Gaussians in the world frame, with gsplat's names and units, all float32.

    means: world units, [gaussians, 3].
    scales: standard deviations along the Gaussian's own axes in world units (not logarithms), [gaussians, 3].
    quats: rotations from the Gaussian's axes to the world, wxyz, [gaussians, 4].
    opacities: in [0, 1] (not logits), [gaussians].
    sh: SH coefficients in the basis of 3DGS (`geometry.sh`), [gaussians, (degree + 1)^2, 3].

    Raises InputError if the shapes do not agree.
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
        """The Gaussians at a mask or at indices, in their order."""
        return Gaussians(*(getattr(self, field.name)[index] for field in fields(self)))

    @staticmethod
    def concatenate(parts: "Sequence[Gaussians]") -> "Gaussians":
        """All Gaussians of several sets of one SH degree, in their order."""
        names = [field.name for field in fields(Gaussians)]
        return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 3."""
        return isqrt(self.sh.shape[1]) - 1

    @property
    def colours(self) -> np.ndarray:
        """RGB of SH degree 0, 0.5 + SH_0 sh_0, usually in [0, 1], [gaussians, 3]."""
        return 0.5 + np.float32(SH_0) * self.sh[:, 0]


def bytes_in_memory(count: int, sh_degree: int) -> int:
    """Size of `count` Gaussians of an SH degree."""
    return count * FLOAT32_BYTES * (VALUES_WITHOUT_SH + 3 * (sh_degree + 1) ** 2)


def check_ranges(path: Path, gaussians: Gaussians) -> None:
    """Raise InputError, before a file is written, for log scales or opacity logits where `Gaussians` has neither."""
    if (gaussians.scales < 0).any():
        raise InputError(f"cannot write {path}: scales holds negative values; pass standard deviations, not logarithms")
    if ((gaussians.opacities < 0) | (gaussians.opacities > 1)).any():
        raise InputError(f"cannot write {path}: opacities holds values outside [0, 1]; pass opacities, not logits")


def check_finite(path: Path, gaussians: Gaussians) -> None:
    """Raise InputError for the first value, read from or to be written to a file, that is not finite."""
    for field in fields(gaussians):
        finite = np.isfinite(getattr(gaussians, field.name))
        if not finite.all():
            at = int(np.argwhere(~finite)[0, 0])
            raise_input_error(path, f"{field.name} of Gaussian {at} is not a finite number", "leave that Gaussian out")


def with_colours(
    means: np.ndarray, scales: np.ndarray, quats: np.ndarray, opacities: np.ndarray, colours: np.ndarray
) -> Gaussians:
    """Gaussians of SH degree 0 with these colours, RGB [gaussians, 3], as contiguous float32 arrays."""
    sh = (colours[:, None] - 0.5) / SH_0
    return Gaussians(*(np.ascontiguousarray(array, np.float32) for array in (means, scales, quats, opacities, sh)))
