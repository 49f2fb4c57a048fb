"""How many threads our own computations take: one for each core, unless a process was given fewer."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

_LIMITS: list[int] = []


def limit_threads(count: int) -> None:
    """Take at most this many threads from now on, as one of several processes that share the machine."""
    _LIMITS[:] = [count]


def thread_count() -> int:
    """The number of threads to start."""
    return min(os.cpu_count() or 1, *_LIMITS) if _LIMITS else os.cpu_count() or 1


def map_in_threads(task: Callable[[int], Result], count: int, threads: int | None = None) -> list[Result]:
    """What a task gives for the numbers from 0 to `count` - 1, in their order. threads: by default `thread_count()`."""
    with ThreadPoolExecutor(threads or thread_count()) as pool:  # which starts no more than it has tasks
        return list(pool.map(task, range(count)))
