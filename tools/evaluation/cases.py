"""Evaluation cases: context views for a network, and held-out target views."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...runtime.cameras.camera import Camera
from ...runtime.geometry.consistency import project_to_view
from ...runtime.geometry.intrinsics import denormalize_intrinsics
from ...runtime.splats.points import unproject

# Relative difference of depths of the same surface.
SAME_SURFACE = 0.02


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Images with their cameras, at the network's size.

    names: of the images, [views].
    images: float32 RGB in [0, 1], [views, 3, height, width].
    extrinsics: camera-to-world, OpenCV axes, [views, 4, 4].
    intrinsics: row 0 divided by the width, row 1 by the height, [views, 3, 3].
    valid: bool, [views, height, width]; False where undistortion filled the image with no data.
    """

    names: list[str]
    images: np.ndarray
    extrinsics: np.ndarray
    intrinsics: np.ndarray
    valid: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def image(self, view: int) -> np.ndarray:
        """One image, [height, width, 3], contiguous."""
        return self._rgb[view]

    @cached_property
    def _rgb(self) -> np.ndarray:
        # The search for the best plane reads each image hundreds of times, and OpenCV needs them contiguous.
        return np.ascontiguousarray(self.images.transpose(0, 2, 3, 1))

    def K(self, view: int) -> np.ndarray:
        """One view's intrinsics in pixels, pixel centres at .5, [3, 3], float64."""
        height, width = self.images.shape[2:]
        return denormalize_intrinsics(self.intrinsics[view], width, height)

    def cameras(self) -> list[Camera]:
        """The camera of each image, by its name; raises InputError as `Camera`."""
        height, width = self.images.shape[2:]
        return [
            Camera(name, width, height, self.K(view), self.extrinsics[view]) for view, name in enumerate(self.names)
        ]


@dataclass(frozen=True, eq=False)
class EvalCase:
    """Context views for a network, and held-out target views of the same scene.

    near, far: the depth range, in scene units. depth: true z-depth of the context views in scene units,
    [views, height, width], not positive where unknown; None without ground truth.
    covisible: whether some context view sees the surface at a target's pixel, bool [targets, height, width]; None
    without ground truth.
    matched: whether another context view sees the surface at a context view's pixel, bool [views, height, width]; None
    without ground truth.
    """

    name: str
    context: PosedImages
    targets: PosedImages
    near: float
    far: float
    depth: np.ndarray | None = None
    covisible: np.ndarray | None = None
    matched: np.ndarray | None = None


def synthetic_case(
    seed: int, context: int, pool: int, targets: int, height: int, width: int, zoom: int = 1
) -> EvalCase:
    """The synthetic scene of a seed, with exact depth; the same arguments give the same case.

    pool: context views rendered along a path, of which `context` are given to the network, evenly spaced.
    zoom: targets are crops of images rendered this many times as large as the context's.
    """
    from ..synthetic.sampler import generate_sample

    sample = generate_sample(seed, pool, targets, height, width, target_zooms=(zoom,) * targets)
    chosen = np.linspace(0, pool - 1, context).round().astype(int)

    def posed(kind: str, views: np.ndarray | slice) -> PosedImages:
        images = sample.images[views]
        names = [f"{kind}{index}" for index in range(len(images))]
        valid = np.ones((len(images), height, width), bool)
        return PosedImages(names, images, sample.extrinsics[views], sample.intrinsics[views], valid)

    given, held_out = posed("context", chosen), posed("target", slice(pool, None))
    depth = sample.depth[chosen]
    views = range(context)
    covisible = find_covisible(
        unproject(sample.depth[pool:], held_out.extrinsics, held_out.intrinsics), depth, given, views
    )
    points = unproject(depth, given.extrinsics, given.intrinsics)
    matched = np.stack([find_covisible(points[view], depth, given, {*views} - {view}) for view in views])
    return EvalCase(str(seed), given, held_out, sample.near, sample.far, depth, covisible, matched)


def find_covisible(points: np.ndarray, depth: np.ndarray, views: PosedImages, asked: Iterable[int]) -> np.ndarray:
    """Whether some of the views asked sees points [..., 3] in world coordinates, bool [...].

    depth: the views' true z-depth, [views, height, width]. A point is seen where it agrees with a view's depth.
    """
    seen = np.zeros(points.shape[:-1], bool)
    for view in asked:
        surface = depth[view]
        pixel, z, inside = project_to_view(points, surface.shape, views.extrinsics[view], views.intrinsics[view])
        seen |= inside & (np.abs(surface.ravel()[pixel] - z) < SAME_SURFACE * z)
    return seen
