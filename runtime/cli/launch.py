"""Entry points of the commands: Ctrl-C is heard before what a command needs is loaded."""

import signal
from functools import partial
from importlib import import_module

from ..errors import SIGNALLED


def _launch(module: str) -> None:
    try:
        import_module(module, __package__).main()
    except KeyboardInterrupt:
        raise SystemExit(SIGNALLED + signal.SIGINT) from None


bench = partial(_launch, "...tools.benchmark.cli")
cameras = partial(_launch, ".cameras")
convert = partial(_launch, ".convert")
evaluate = partial(_launch, "...tools.evaluation.cli")
export = partial(_launch, "...export.cli")
infer = partial(_launch, ".infer")
render = partial(_launch, ".render")
train = partial(_launch, "...tools.training.cli")
view = partial(_launch, ".view")
