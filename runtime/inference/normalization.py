"""The frame and unit in which a network works, and the way there and back."""

from dataclasses import dataclass

import numpy as np

from ..splats.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class SceneNormalization:
    """The user's world, moved to the middle of the cameras and scaled so that near is what it was in training.

    The networks are not indifferent to the unit: they read inverse depths as numbers and predict the size of splats in
    scene units. And a network works in float32, in which cameras far from the origin would lose their baseline.

    origin: the middle of the cameras in the user's world, float64 [3]. scale: network units in one of the user's.
    """

    origin: np.ndarray
    scale: float

    @classmethod
    def of(cls, extrinsics: np.ndarray, near: np.ndarray, trained_near: float) -> "SceneNormalization":
        """The frame for cameras [views, 4, 4] with these nearest depths [views]."""
        return cls(extrinsics[:, :3, 3].mean(axis=0, dtype=np.float64), float(trained_near / np.min(near)))

    def apply(self, extrinsics: np.ndarray) -> np.ndarray:
        """Camera-to-world poses [views, 4, 4] of the user's world in this one, float32."""
        entered = np.array(extrinsics, np.float64)
        entered[:, :3, 3] = (entered[:, :3, 3] - self.origin) * self.scale
        return entered.astype(np.float32)

    def invert_depth(self, depth: np.ndarray) -> np.ndarray:
        """Depth in the user's unit, float32."""
        return (depth / np.float64(self.scale)).astype(np.float32)

    def invert(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in the user's world and unit."""
        scale = np.float64(self.scale)
        means = (gaussians.means / scale + self.origin).astype(np.float32)
        scales = (gaussians.scales / scale).astype(np.float32)
        return Gaussians(means, scales, gaussians.quats, gaussians.opacities, gaussians.sh)
