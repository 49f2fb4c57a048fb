"""`InputError`, the exception for invalid input, and how commands report errors.

A message is one line: what is wrong, where, what was expected, and the remedy. Commands print it without a traceback
and exit with `EXIT_STATUS`; library users catch `InputError`.
"""

import contextlib
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

EXIT_STATUS = 2
SIGNALLED = 128  # added to the signal's number in the exit status, as shells do
BROKEN_PIPE = SIGNALLED + 13  # SIGPIPE, which is not defined on Windows
MAX_ERROR_LENGTH = 2000  # characters; options and names in files can have any length


class InputError(ValueError):
    """An input is invalid: a file, a camera, an option."""


class Terminated(KeyboardInterrupt):
    """A signal that asks the process to end, raised as an exception so that it cleans up as after Ctrl-C."""

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.signal_number = signal_number


def raise_input_error(path: Path | str, what: str, remedy: str) -> NoReturn:
    """Raise InputError for a file: what is wrong, and what was expected or the remedy."""
    raise InputError(f"{path}: {what}; {remedy}")


def printable(text: str) -> str:
    """The text with control characters, bidirectional overrides and lone surrogates as escapes, such as \\x1b.

    Names of files and cameras can contain them, and a terminal would interpret them. Line breaks and tabs are escaped.
    """
    return "".join(character if _is_shown(character) else _escape(character) for character in text)


def one_line(error: BaseException) -> str:
    """The message of any exception as one line; the name of its type if it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def report_error(message: str) -> None:
    """Print an error as one line on stderr, if it is writable; the middle of a very long one is left out."""
    line = printable(" ".join(message.split()))
    if len(line) > MAX_ERROR_LENGTH:
        line = f"{line[: MAX_ERROR_LENGTH // 2]} ... {line[-MAX_ERROR_LENGTH // 2 :]}"
    with contextlib.suppress(OSError):
        print(f"error: {line}", file=sys.stderr)


def _is_shown(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"  # spaces of all widths


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


@contextmanager
def error_context(where: str) -> Iterator[None]:
    """Prefix the message of an InputError raised in the block with `where`: a file, a frame or a field.

    Not if the message already begins with a path that contains `where`.
    """
    try:
        yield
    except InputError as error:
        path = Path(str(error).partition(": ")[0])
        known = where in (path.name, str(path), *map(str, path.parents))
        raise InputError(str(error) if known else f"{where}: {error}") from None
