"""The decorator of every command: checked outputs (`system.outputs`), logging, and JSON on standard output."""

import functools
import sys
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout
from pathlib import Path
from typing import Any

from ..system.files import atomic_write
from ..system.outputs import Outputs, outputs
from .reporting import reporting

STANDARD_OUTPUT = Path("-")  # the value of --json for standard output


def command(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator of every command: checks outputs with `outputs()`, and reserves standard output for `--json -`.

    name: the command's. Of its parameters `overwrite`, `json_path`, `quiet` and `verbose` are used here.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            with Outputs(name, bool(kwargs.get("overwrite"))), ExitStack() as stack:
                if kwargs.get("json_path") == STANDARD_OUTPUT:
                    stack.enter_context(redirect_stdout(sys.stderr))
                stack.enter_context(reporting(bool(kwargs.get("quiet")), int(kwargs.get("verbose") or 0)))
                return function(*args, **kwargs)

        return wrapped

    return decorate


def write_json(path: Path, text: str) -> None:
    """Write JSON to a file, or print it where the file is called "-"; raises InputError if it cannot be written."""
    if path == STANDARD_OUTPUT:
        print(text, file=outputs().stdout)
        return
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
