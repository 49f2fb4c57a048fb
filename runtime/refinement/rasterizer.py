"""Rendering with gradients: the compiled kernels on the machine's cores."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from ..system.compilation import compiling
from ..system.threads import thread_count
from . import compositing, kernels

NEAR = 0.01  # world units
MOST_THREADS = 8
BLOCK = 1 << 13  # Gaussians of one task
FIRST_FRAGMENTS = 1 << 14  # for which a band has room at first
BETA_1, BETA_2 = 0.9, 0.999  # of Adam, as 3DGS has them


@dataclass(eq=False)
class Parameters:
    """What is optimised, as contiguous arrays of one float type: log scales, and logits of the opacities."""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    logits: np.ndarray
    sh: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def select(self, chosen: np.ndarray) -> "Parameters":
        """A copy of the Gaussians with these indices."""
        return Parameters(
            self.means[chosen], self.quats[chosen], self.log_scales[chosen], self.logits[chosen], self.sh[chosen]
        )

    @property
    def columns(self) -> int:
        """Numbers of one Gaussian."""
        return 11 + 3 * self.sh.shape[1]


@dataclass(frozen=True, eq=False)
class Target:
    """A view to render: viewmat is world-to-camera [4, 4], K in pixels [3, 3], both float64."""

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int


@dataclass(eq=False)
class Pass:
    """A forward pass, with what the backward pass needs of it."""

    rgb: np.ndarray
    transmittance: np.ndarray
    projected: np.ndarray
    boxes: np.ndarray
    offsets: np.ndarray
    entries: "Entries"
    target: Target


@dataclass(frozen=True, eq=False)
class Entries:
    """The entries of a pass and their fragments, as `compositing` describes them.

    keys: sorted in each band. starts: each band's first entry, and the number of all. ends: the fragment of its band
    after an entry's last one. fragments: each band's.
    """

    keys: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    fragments: "list[Fragments]"


@dataclass(frozen=True, eq=False)
class Fragments:
    """Room for the fragments of a band: their pixels and alphas."""

    pixels: np.ndarray
    alphas: np.ndarray

    @classmethod
    def empty(cls, count: int, dtype: np.dtype) -> "Fragments":
        """Room for so many."""
        return cls(np.empty(count, np.int32), np.empty(count, dtype))

    def enlarged(self) -> "Fragments":
        """Twice the room, with the same fragments first."""
        larger = Fragments.empty(2 * len(self.pixels), self.alphas.dtype)
        larger.pixels[: len(self.pixels)], larger.alphas[: len(self.alphas)] = self.pixels, self.alphas
        return larger


def compile_all() -> None:
    """Compile what is not yet, by a step on one Gaussian."""
    arrays = ([[0, 0, 1]], [[1, 0, 0, 0]], [[0, 0, 0]], [0], [[[0, 0, 0]]])
    parameters = Parameters(*(np.array(array, np.float32) for array in arrays))
    with compiling(kernels.adam_step, "the refinement"):
        rasterizer = GradientRasterizer(parameters)
        done = rasterizer.forward(Target(np.eye(4), np.eye(3), 1, 1))
        moments, lr = np.zeros((1, 2, parameters.columns), np.float32), np.zeros(parameters.columns)
        gradients = rasterizer.backward(done, np.zeros_like(done.rgb))
        rasterizer.weights(done, gradients)
        rasterizer.step(done, gradients, moments, lr, 1, np.zeros((1, 3), np.float32))


@dataclass(eq=False)
class GradientRasterizer:
    """Renders parameters, and leads gradients of the image back to them."""

    parameters: Parameters
    _pool: ThreadPoolExecutor = field(init=False)

    def __post_init__(self) -> None:
        self._pool = ThreadPoolExecutor(min(MOST_THREADS, thread_count()))
        count, dtype = len(self.parameters), self.parameters.means.dtype
        self._projected = np.zeros((count, compositing.PROJECTED), dtype)
        self._boxes = np.zeros((count, 4), np.int32)
        self._offsets = np.zeros(count, np.int64)
        self._fragments: list[Fragments] = []  # kept from pass to pass: memory that was never used costs time

    def forward(self, target: Target) -> Pass:
        """Render a view. The pass is valid until the next one."""
        p, width, height = self.parameters, target.width, target.height
        projected, boxes = self._projected, self._boxes

        def project(start: int, stop: int) -> None:
            kernels.project(
                p.means, p.quats, p.log_scales, p.logits, p.sh, target.viewmat, target.K,
                width, height, NEAR, start, stop, projected, boxes,
            )  # fmt: skip

        self._over_gaussians(project)
        e = self._entries(-(-height // compositing.BAND_ROWS))
        dtype = projected.dtype
        rgb, transmittance = np.zeros((height, width, 3), dtype), np.ones((height, width), dtype)

        def composite(band: int) -> None:
            place, stop, fragment = e.starts[band], e.starts[band + 1], 0
            e.keys[place:stop].sort()
            while True:
                room = e.fragments[band]
                place, fragment = compositing.composite(
                    e.keys, place, stop, projected, boxes, band, fragment,
                    rgb, transmittance, e.ends, room.pixels, room.alphas,
                )  # fmt: skip
                if place == stop:
                    return
                e.fragments[band] = room.enlarged()

        self._over_bands(composite, len(e.starts) - 1)
        return Pass(rgb, transmittance, projected, boxes, self._offsets, e, target)

    def _entries(self, bands: int) -> Entries:
        """The entries of the projected Gaussians, unsorted, without fragments."""
        entries = np.zeros(bands, np.int64)
        total = compositing.count_entries(self._boxes, self._offsets, entries)
        starts = np.concatenate([[0], np.cumsum(entries)])
        keys = np.empty(total, np.uint64)
        depth_bits = self._projected[:, compositing.DEPTH].astype(np.float32).view(np.uint32).astype(np.uint64)
        compositing.fill_keys(self._boxes, depth_bits, starts, keys)
        while len(self._fragments) < bands:
            self._fragments.append(Fragments.empty(FIRST_FRAGMENTS, self._projected.dtype))
        return Entries(keys, starts, np.empty(total, np.int64), self._fragments)

    def backward(self, done: Pass, for_rgb: np.ndarray, for_transmittance: np.ndarray | None = None) -> np.ndarray:
        """Gradients of the entries of a pass from those of its rgb and transmittance."""
        through = done.transmittance.flatten()
        behind = np.zeros_like(through) if for_transmittance is None else for_transmittance.flatten() * through
        e, dtype = done.entries, done.rgb.dtype
        gradients = np.empty((len(e.keys), compositing.ENTRY), dtype)
        for_rgb = np.ascontiguousarray(for_rgb, dtype)

        def composite_backward(band: int) -> None:
            compositing.composite_backward(
                e.keys, e.starts[band], e.starts[band + 1], done.projected, done.boxes, band,
                e.ends, e.fragments[band].pixels, e.fragments[band].alphas,
                done.offsets, for_rgb, behind, through, gradients,
            )  # fmt: skip

        self._over_bands(composite_backward, len(e.starts) - 1)
        return gradients

    def weights(self, done: Pass, gradients: np.ndarray) -> np.ndarray:
        """Each Gaussian's weight in the image, the sum of alpha T over the pixels, float64 [gaussians]."""
        return self._columns(done, gradients, compositing.WEIGHT)[:, 0]

    def color_sums(self, done: Pass, gradients: np.ndarray) -> np.ndarray:
        """Sums over the pixels of alpha T times the gradient of the rgb, and of alpha T, float64 [gaussians, 4]."""
        return self._columns(done, gradients, compositing.RED)

    def _columns(self, done: Pass, gradients: np.ndarray, first: int) -> np.ndarray:
        """The sums of the columns from `first` on over each Gaussian's entries."""
        total = np.zeros((len(self.parameters), compositing.ENTRY - first))
        self._over_gaussians(
            lambda start, stop: compositing.add_columns(done.boxes, done.offsets, gradients, first, start, stop, total)
        )
        return total

    def parameter_gradients(self, done: Pass, gradients: np.ndarray) -> np.ndarray:
        """Gradients of the parameters from those of the entries, float64 [gaussians, columns]."""
        p, target = self.parameters, done.target
        out = np.zeros((len(p), p.columns))

        def differentiate(start: int, stop: int) -> None:
            kernels.parameter_gradients(
                p.means, p.quats, p.log_scales, p.sh, target.viewmat, target.K, target.width, target.height,
                start, stop, done.projected, done.boxes, done.offsets, gradients, out,
            )  # fmt: skip

        self._over_gaussians(differentiate)
        return out

    def pose_gradient(self, done: Pass, gradients: np.ndarray) -> np.ndarray:
        """Gradient of a pass's pose from those of its entries, float64 [6] (`kernels.pose_gradient`)."""
        p, target = self.parameters, done.target
        parts = np.zeros((-(-len(p) // BLOCK), 6))

        def differentiate(start: int, stop: int) -> None:
            kernels.pose_gradient(
                p.means, p.quats, p.log_scales, p.sh, target.viewmat, target.K, target.width, target.height,
                start, stop, done.projected, done.boxes, done.offsets, gradients, parts[start // BLOCK],
            )  # fmt: skip

        self._over_gaussians(differentiate)
        total: np.ndarray = parts.sum(axis=0)  # in an order that does not depend on the threads
        return total

    def step(
        self,
        done: Pass,
        gradients: np.ndarray,
        moments: np.ndarray,
        lr: np.ndarray,
        count: int,
        directions: np.ndarray,
        opacity_decay: float = 0.0,
        scale_growth: float = 0.0,
    ) -> None:
        """One step of Adam, the `count`-th (from 1), on the Gaussians that the pass saw (`kernels.adam_step`)."""
        p, target = self.parameters, done.target
        rates, correction = (lr / (1 - BETA_1**count)).astype(np.float32), 1 / (1 - BETA_2**count)

        def adam_step(start: int, stop: int) -> None:
            kernels.adam_step(
                p.means, p.quats, p.log_scales, p.logits, p.sh, target.viewmat, target.K, target.width, target.height,
                start, stop, done.projected, done.boxes, done.offsets, gradients, moments, rates,
                BETA_1, BETA_2, correction, opacity_decay, scale_growth, directions,
            )  # fmt: skip

        self._over_gaussians(adam_step)

    def _over_gaussians(self, task: Callable[[int, int], None]) -> None:
        count = len(self.parameters)
        list(self._pool.map(lambda start: task(start, min(start + BLOCK, count)), range(0, count, BLOCK)))

    def _over_bands(self, task: Callable[[int], None], bands: int) -> None:
        list(self._pool.map(task, range(bands)))
