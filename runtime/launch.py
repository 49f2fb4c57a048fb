"""Entry points of the commands: Ctrl-C is heard before what a command needs is loaded."""

import signal
from importlib import import_module

from .errors import SIGNALLED


def bench() -> None:
    """Run idesplat-bench."""
    _launch("..tools.bench")


def cameras() -> None:
    """Run idesplat-cameras."""
    _launch(".convert_cameras")


def convert() -> None:
    """Run idesplat-convert."""
    _launch(".convert")


def evaluate() -> None:
    """Run idesplat-eval."""
    _launch("..tools.evaluate")


def export() -> None:
    """Run idesplat-export."""
    _launch("..export.cli")


def infer() -> None:
    """Run idesplat-infer."""
    _launch(".cli")


def render() -> None:
    """Run idesplat-render."""
    _launch(".render")


def train() -> None:
    """Run idesplat-train."""
    _launch("..tools.train")


def view() -> None:
    """Run idesplat-view."""
    _launch(".view")


def _launch(module: str) -> None:
    try:
        import_module(module, __package__).main()
    except KeyboardInterrupt:
        raise SystemExit(SIGNALLED + signal.SIGINT) from None
