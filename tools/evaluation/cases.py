"""What is evaluated: views that a network is given, and views that it is to meet."""

from dataclasses import dataclass

import numpy as np

from ...runtime.geometry.consistency import project_to_view
from ...runtime.splats.points import unproject

# Depths that differ by less than this share are of one surface.
SAME_SURFACE = 0.02


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Images with their cameras at the network's size.

    names: of the images, [views].
    images: float32 RGB in [0, 1], [views, 3, height, width].
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4].
    intrinsics: row 0 divided by the width, row 1 by the height, [views, 3, 3].
    valid: bool, [views, height, width]; False where the camera saw nothing and the image was filled.
    """

    names: list[str]
    images: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    valid: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def image(self, view: int) -> np.ndarray:
        """One image, [height, width, 3]."""
        return self.images[view].transpose(1, 2, 0)

    def K(self, view: int) -> np.ndarray:
        """One view's intrinsics in pixels, pixel centres at .5, [3, 3], float64."""
        height, width = self.images.shape[2:]
        return np.diag([width, height, 1.0]) @ self.intrinsics[view]


@dataclass(frozen=True, eq=False)
class EvalCase:
    """Context views for a network, and target views of the same scene that it does not see.

    near, far: the depth range, in scene units. depth: true z-depth of the context views in scene units,
    [views, height, width], not positive where unknown; None where there is none.
    covisible: whether some context view sees the surface that a target's pixel shows, bool [targets, height, width];
    None where that is not known.
    """

    name: str
    context: PosedImages
    targets: PosedImages
    near: float
    far: float
    depth: np.ndarray | None = None
    covisible: np.ndarray | None = None


def synthetic_case(
    seed: int, context: int, pool: int, targets: int, height: int, width: int, closer: int = 1
) -> EvalCase:
    """The procedural scene of `seed`, with exact depth; the same arguments give the same case.

    pool: context views rendered along a path, of which `context` are given to the network, evenly spaced.
    closer: how many times as large targets are rendered as the context; they are windows of such images then.
    """
    from ..synthetic.sampler import generate_sample

    sample = generate_sample(seed, pool, targets, height, width, target_zooms=(closer,) * targets)
    given = np.linspace(0, pool - 1, context).round().astype(int)

    def posed(kind: str, views: np.ndarray | slice) -> PosedImages:
        images = sample.images[views]
        names = [f"{kind}{index}" for index in range(len(images))]
        valid = np.ones((len(images), height, width), bool)
        return PosedImages(names, images, sample.extrinsics[views], sample.intrinsics[views], valid)

    chosen, met = posed("context", given), posed("target", slice(pool, None))
    depth = sample.depth[given]
    covisible = find_covisible(unproject(sample.depth[pool:], met.extrinsics, met.intrinsics), depth, chosen)
    return EvalCase(str(seed), chosen, met, sample.near, sample.far, depth, covisible)


def find_covisible(points: np.ndarray, depth: np.ndarray, views: PosedImages) -> np.ndarray:
    """Whether some view sees points [..., 3], from the views' true z-depth [views, height, width]."""
    seen = np.zeros(points.shape[:-1], bool)
    for surface, extrinsics, intrinsics in zip(depth, views.extrinsics, views.intrinsics, strict=True):
        pixel, z, inside = project_to_view(points, surface.shape, extrinsics, intrinsics)
        seen |= inside & (np.abs(surface.ravel()[pixel] - z) < SAME_SURFACE * z)
    return seen
