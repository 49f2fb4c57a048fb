"""The one exception that stands for "your input, not our code", and the exit status that goes with it.

Every message is one line that says what is wrong, where, what was expected and what to do. The commands
print it without a traceback and exit with `EXIT_STATUS`; library users catch `InputError`.
"""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

EXIT_STATUS = 2


class InputError(ValueError):
    """Something the user gave cannot be used: a file, a camera, an option."""


def refuse(path: Path, what: str, remedy: str) -> NoReturn:
    """Raise InputError for a file: what is wrong with it, and what was expected or to do."""
    raise InputError(f"{path}: {what}; {remedy}")


def exit_on_input_error(command: Callable[..., Any]) -> Callable[..., Any]:
    """Make a command print an `InputError` as one line on stderr and exit with status 2."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except InputError as error:
            message = " ".join(str(error).split())
            print(f"error: {message}", file=sys.stderr)
            raise SystemExit(EXIT_STATUS) from None

    return wrapped
