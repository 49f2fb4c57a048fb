"""How many threads our own computations take: one for each core, unless a process was given fewer."""

import os

_LIMITS: list[int] = []


def limit_threads(count: int) -> None:
    """Take at most this many threads from now on, as one of several processes that share the machine."""
    _LIMITS[:] = [count]


def thread_count() -> int:
    """The number of threads to start."""
    return min(os.cpu_count() or 1, *_LIMITS) if _LIMITS else os.cpu_count() or 1
