"""The one exception that stands for "your input, not our code", and how a command ends.

Every message is one line that says what is wrong, where, what was expected and what to do. The commands
print it without a traceback and exit with `EXIT_STATUS`; library users catch `InputError`.
"""

import contextlib
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

EXIT_STATUS = 2
SIGNALLED = 128  # a shell's exit status of a command that a signal ended is this and the signal's number
BROKEN_PIPE = SIGNALLED + 13  # SIGPIPE, which Windows does not name
MAX_ERROR_LENGTH = 2000  # characters: an option, or a name in a file, may have any length


class InputError(ValueError):
    """Something the user gave cannot be used: a file, a camera, an option."""


class Terminated(KeyboardInterrupt):
    """A signal that asks the process to end: it cleans up as after Ctrl-C."""

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.signal_number = signal_number


def raise_input_error(path: Path, what: str, remedy: str) -> NoReturn:
    """Raise InputError for a file: what is wrong with it, and what was expected or to do."""
    raise InputError(f"{path}: {what}; {remedy}")


def printable(text: str) -> str:
    """The text with control characters, bidirectional overrides and lone surrogates as escapes, such as \\x1b.

    Names of files and cameras may hold them, and a terminal would obey them. Line breaks and tabs are escaped, too.
    """
    return "".join(character if _is_shown(character) else _escape(character) for character in text)


def report_error(message: str) -> None:
    """Print an error as one line on stderr, where that can be written; of a very long one, beginning and end."""
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
    """Put `where` (a file, a frame, a field) in front of the message of an InputError raised inside the block.

    Once only: what reads a whole file begins with its path, which may end in `where`, or lead through it.
    """
    try:
        yield
    except InputError as error:
        path = Path(str(error).partition(": ")[0])
        known = where in (path.name, str(path), *map(str, path.parents))
        raise InputError(str(error) if known else f"{where}: {error}") from None
