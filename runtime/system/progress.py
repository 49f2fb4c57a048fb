"""Progress of long work, reported to a callback; without one, as in library use, nothing is printed."""

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Progress:
    """The state of one piece of work: reported when it starts, after each item, and once more when it has ended.

    description: what is being done, such as `finding features`.
    done, total: items; total is None where it is not known.
    ended: the last report about this work, also where it was interrupted.
    """

    description: str
    done: int
    total: int | None
    ended: bool = False
    detail: str = ""


ProgressCallback = Callable[[Progress], None]

CALLBACK: ContextVar[ProgressCallback | None] = ContextVar("CALLBACK", default=None)


@contextmanager
def reporting_to(callback: ProgressCallback | None) -> Iterator[None]:
    """Report progress to `callback`, in the thread that runs the block."""
    token = CALLBACK.set(callback)
    try:
        yield
    finally:
        CALLBACK.reset(token)


def progress(
    items: Iterable[T], description: str, total: int | None = None, detail: Callable[[], str] = str
) -> Iterator[T]:
    """Yield the items, and report each.

    total: how many there are, where `items` has no length. detail: gives what is worth showing of the state.
    """
    callback = CALLBACK.get()
    if callback is None:
        yield from items
        return
    if total is None and isinstance(items, Sized):
        total = len(items)
    done = 0
    callback(Progress(description, done, total))
    try:
        for item in items:
            yield item
            done += 1
            callback(Progress(description, done, total, detail=detail()))
    finally:
        callback(Progress(description, done, total, ended=True))


@contextmanager
def working(description: str) -> Iterator[None]:
    """Report the start and the end of work without items, which the block does."""
    callback = CALLBACK.get()
    if callback is None:
        yield
        return
    callback(Progress(description, 0, None))
    try:
        yield
    finally:
        callback(Progress(description, 0, None, ended=True))
