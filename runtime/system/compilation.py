"""Compilation by numba: one set of options, code kept in the cache folder, and a word to the user while it compiles."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numba

from .progress import working

F = TypeVar("F", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[F], F]:
    """Compile a function without Python objects, so that threads run it side by side. options: of `numba.njit`."""

    def decorate(function: F) -> F:
        settings = {"nogil": True, "error_model": "numpy", **options}
        try:
            return numba.njit(cache=True, **settings)(function)
        except RuntimeError:  # there is no folder to keep it in, so it is compiled in every process
            return numba.njit(**settings)(function)

    return decorate


@contextmanager
def compiling(function: Callable[..., Any], what: str) -> Iterator[None]:
    """Say in the block that `what` is compiled, unless the function, which stands for it, was compiled before."""
    if function.signatures or _kept(function):  # type: ignore[attr-defined]
        yield
        return
    with working(f"compiling {what}, once on this computer"):
        yield


def _kept(function: Callable[..., Any]) -> bool:
    """Whether compiled code of the function is in the cache folder."""
    cache = getattr(getattr(function, "_cache", None), "_cache_file", None)
    return cache is not None and Path(cache._index_path).exists()
