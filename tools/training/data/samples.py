"""A training sample: how it is specified, its tensors, and loading ahead of time."""

import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ....runtime.errors import InputError
from ....runtime.views.matching import PointMatches
from ...processes import safe_path

# Samples that are loaded ahead of their use.
PREFETCHED = 4

T = TypeVar("T")
# Indices of two context views of a scene, and the points matched between them, for each pair.
SceneMatches = tuple[tuple[int, int, PointMatches], ...]


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
    # How many scenes the context views are of, each with as many; they follow each other (`stack_scenes`).
    scenes: int = 1
    # Of each scene the points matched between its context views, where they are used.
    matches: tuple[SceneMatches, ...] | None = None

    def to(self, device: torch.device) -> "TrainingViews":
        """The same views on a device."""
        moved: dict[str, Any] = {name: part.to(device) for name, part in vars(self).items() if isinstance(part, Tensor)}
        return replace(self, **moved)


def stack_scenes(scenes: Sequence[TrainingViews]) -> TrainingViews:
    """The views of synthetic scenes that have as many context views as each other, for one pass of the network."""
    names = [name for name, part in vars(scenes[0]).items() if isinstance(part, Tensor)]
    stacked: dict[str, Any] = {name: torch.cat([getattr(views, name) for views in scenes]) for name in names}
    matches = tuple(of_scene for views in scenes for of_scene in views.matches or ())
    return replace(scenes[0], **stacked, scenes=len(scenes), matches=matches or None)


def prefetch(specs: Iterator[SampleSpec], load: Callable[[SampleSpec], T]) -> Generator[T]:
    """The samples of `specs`, in that order, loaded by a background thread.

    Close the generator where it is not exhausted. Left to the garbage collector, it ends its thread in whichever thread
    collects it, which waits for itself if it is just starting or ending.
    """
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


def prefetch_in_processes(
    specs: Sequence[SampleSpec], load: Callable[[SampleSpec], TrainingViews], processes: int
) -> Generator[TrainingViews]:
    """The samples of `specs`, in that order, loaded by `processes` processes, which end when it is closed.

    load: can be pickled. An InputError of it is raised here.
    """
    loader: DataLoader[TrainingViews | InputError] = DataLoader(
        _Samples(specs, load),
        batch_size=None,
        num_workers=processes,
        prefetch_factor=PREFETCHED,
        multiprocessing_context="spawn",
        worker_init_fn=_ignore_interrupt,
    )
    with safe_path():
        return _without_errors(iter(loader))


def _without_errors(samples: Iterator[TrainingViews | InputError]) -> Generator[TrainingViews]:
    """The samples; raises the first error among them."""
    for sample in samples:
        if isinstance(sample, InputError):
            raise sample
        yield sample


class _Samples(Dataset[TrainingViews | InputError]):
    """The samples of specifications, loaded when they are asked for.

    An InputError takes the place of its sample: raised in a process of `DataLoader`, it would lose its message.
    """

    def __init__(self, specs: Sequence[SampleSpec], load: Callable[[SampleSpec], TrainingViews]) -> None:
        self.specs, self.load = specs, load

    def __len__(self) -> int:
        return len(self.specs)

    def __getitem__(self, index: int) -> TrainingViews | InputError:
        try:
            return self.load(self.specs[index])
        except InputError as error:
            return InputError(str(error))


def _ignore_interrupt(_: int) -> None:
    """A terminal sends SIGINT to all processes; that which trains handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
