"""A training sample: how it is specified, its tensors, and loading ahead of time."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

# Samples that are loaded ahead of their use.
PREFETCHED = 4

T = TypeVar("T")


@dataclass(frozen=True)
class SampleSpec:
    """Which sample a step uses; the same specification gives the same sample.

    seed: of the synthetic scene, or of the choice of a capture's views. context: number of context views.
    target_zooms: for each target view, how many times as large as the context images the image is from which the
    target is a random crop. height, width: of all images, in pixels. real: whether the views come from a capture,
    where a run has both kinds.
    """

    seed: int
    context: int
    target_zooms: tuple[int, ...]
    height: int
    width: int
    real: bool = False


@dataclass(frozen=True)
class TrainingViews:
    """The views of one scene: the network's input, and the truth. Lengths are in scene units."""

    images: Tensor  # [context, 3, H, W] in [0, 1]
    extrinsics: Tensor  # [context, 4, 4] camera-to-world, OpenCV axes
    intrinsics: Tensor  # [context, 3, 3] normalised by width and height
    near: Tensor  # [context]
    far: Tensor  # [context]
    inverse_depth: Tensor | None  # [context, H, W], the truth; None for captures
    target_images: Tensor  # [targets, 3, H, W]
    target_extrinsics: Tensor  # [targets, 4, 4]
    target_intrinsics: Tensor  # [targets, 3, 3]
    # Of captures, where given: a point for each pixel of the context views, in a frame and a scale of its own, NaN
    # where unknown, [context * H * W, 3].
    pointmap: Tensor | None = None

    def to(self, device: torch.device) -> "TrainingViews":
        """The same views on a device."""
        return replace(self, **{name: part.to(device) for name, part in vars(self).items() if part is not None})


def prefetch(specs: Iterator[SampleSpec], load: Callable[[SampleSpec], T]) -> Generator[T]:
    """The samples of `specs`, in that order, loaded by a background thread."""
    with ThreadPoolExecutor(1, thread_name_prefix="samples") as pool:
        pending: deque[Future[T]] = deque()
        try:
            for spec in specs:
                pending.append(pool.submit(load, spec))
                if len(pending) > PREFETCHED:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
