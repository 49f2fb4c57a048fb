"""Progress bars: on stderr, and only where that is a terminal."""

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")


def progress(items: Sequence[T], doing: str) -> Iterable[T]:
    """The items, with a bar that says what is being done with them."""
    from rich.console import Console
    from rich.progress import track

    return track(items, doing, console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True)
