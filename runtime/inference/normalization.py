"""Normalisation of a scene to the frame and unit in which networks were trained, and its inverse."""

from dataclasses import dataclass

import numpy as np

from ..splats.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class SceneNormalization:
    """A translation to the mean of the camera positions and a scale that makes near what it was in training.

    The networks depend on the unit: inverse depths are inputs, and the scales of splats are predicted in scene units.
    They compute in float32, in which cameras far from the origin would lose their baseline. With x in world units,
    x_network = (x - origin) * scale.

    origin: the mean camera position in the world, float64 [3]. scale: network units per world unit.
    """

    origin: np.ndarray
    scale: float

    @classmethod
    def of(cls, extrinsics: np.ndarray, near: np.ndarray, trained_near: float) -> "SceneNormalization":
        """The normalisation for camera-to-world poses [views, 4, 4] and near depths [views]."""
        return cls(extrinsics[:, :3, 3].mean(axis=0, dtype=np.float64), float(trained_near / np.min(near)))

    def apply(self, extrinsics: np.ndarray) -> np.ndarray:
        """Normalise camera-to-world poses [views, 4, 4]; float32."""
        normalized = np.array(extrinsics, np.float64)
        normalized[:, :3, 3] = (normalized[:, :3, 3] - self.origin) * self.scale
        return normalized.astype(np.float32)

    def invert_depth(self, depth: np.ndarray) -> np.ndarray:
        """Depth in world units, float32."""
        return (depth / np.float64(self.scale)).astype(np.float32)

    def invert(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in the world frame and unit."""
        scale = np.float64(self.scale)
        means = (gaussians.means / scale + self.origin).astype(np.float32)
        scales = (gaussians.scales / scale).astype(np.float32)
        return Gaussians(means, scales, gaussians.quats, gaussians.opacities, gaussians.sh)
