"""Entry points of the installed commands: Ctrl-C is handled before the modules that a command needs are imported."""

import signal
from functools import partial
from importlib import import_module

from ..errors import SIGNALLED


def _launch(module: str, attribute: str) -> None:
    try:
        command = getattr(import_module(module, __package__), attribute)
        import_module(".terminal", __package__).run(command)
    except KeyboardInterrupt:
        raise SystemExit(SIGNALLED + signal.SIGINT) from None


idesplat = partial(_launch, ".application", "app")
export = partial(_launch, "...export.cli", "export")
infer = partial(_launch, ".infer", "infer")
