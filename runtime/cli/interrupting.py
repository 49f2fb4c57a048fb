"""Ctrl-C that ends a refinement and keeps what it has reached."""

import signal
from types import FrameType
from typing import Any


class StopOnInterrupt:
    """A callback for each step of a refinement, which stops it after SIGINT.

    The signal is handled so from the first step on, until the block ends; before, it aborts the command as usual.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._before: Any = None

    def __enter__(self) -> "StopOnInterrupt":
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def __call__(self, step: int, psnr: float) -> bool:
        """Whether to go on."""
        if self._before is None:
            self._before = signal.signal(signal.SIGINT, self._stop)
        return not self.stopped

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
