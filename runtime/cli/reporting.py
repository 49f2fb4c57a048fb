"""Notes and logging of a command."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar

from ..system.progress import reporting_to
from .terminal import say

LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)  # by how often --verbose is given
_QUIET: ContextVar[bool] = ContextVar("_QUIET", default=False)


@contextmanager
def reporting(quiet: bool = False, verbose: int = 0) -> Iterator[None]:
    """In the block, hide progress and notes if `quiet`, and log to stderr at the level of `verbose`."""
    token = _QUIET.set(quiet)
    try:
        with ExitStack() as stack:
            if verbose:
                stack.enter_context(_logging(LEVELS[min(verbose, len(LEVELS) - 1)]))
            if quiet:
                stack.enter_context(reporting_to(None))
            yield
    finally:
        _QUIET.reset(token)


def note(*lines: str) -> None:
    """Print lines of secondary importance, unless --quiet is given."""
    if not _QUIET.get():
        say(*lines)


def mark_printed(record: logging.LogRecord) -> None:
    """Keep a record out of the log on stderr, since its message was printed."""
    record.printed = True


@contextmanager
def _logging(level: int) -> Iterator[None]:
    """Write what our modules log to stderr."""
    logger, handler = logging.getLogger(__name__.partition(".")[0]), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    handler.addFilter(lambda record: not getattr(record, "printed", False))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)
