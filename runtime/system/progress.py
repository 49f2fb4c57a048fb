"""Progress: on stderr, and only where that is a terminal."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.status import Status

T = TypeVar("T")


def progress(items: Iterable[T], doing: str, total: int | None = None) -> Iterable[T]:
    """The items, with a bar that says what is being done with them; total: how many, where they do not know it."""
    from rich.console import Console
    from rich.progress import track

    return track(items, doing, total, console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True)


def working(doing: str) -> "Status":
    """Something that turns, for as long as the block runs, where nobody knows how long that will be."""
    from rich.console import Console

    return Console(stderr=True).status(doing)
