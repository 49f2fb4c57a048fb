"""Entry points of the commands: Ctrl-C is heard before what a command needs is loaded."""

import signal
from functools import partial
from importlib import import_module

from .errors import SIGNALLED


def _launch(module: str) -> None:
    try:
        import_module(module, __package__).main()
    except KeyboardInterrupt:
        raise SystemExit(SIGNALLED + signal.SIGINT) from None


bench = partial(_launch, "..tools.bench")
cameras = partial(_launch, ".convert_cameras")
convert = partial(_launch, ".convert")
evaluate = partial(_launch, "..tools.evaluate")
export = partial(_launch, "..export.cli")
infer = partial(_launch, ".cli")
render = partial(_launch, ".render")
train = partial(_launch, "..tools.train")
view = partial(_launch, ".view")
