"""What all commands share: exit status, printing, signals, and suppression of libraries' messages."""

import contextlib
import faulthandler
import io
import logging
import os
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TextIO

import typer

from ..errors import (
    BROKEN_PIPE,
    EXIT_STATUS,
    SIGNALLED,
    InputError,
    Terminated,
    printable,
    report_error,
)
from .progress_bar import show_progress

STDERR = 2
SYSTEM_REMEDY = "give files and a standard output that can be read and written, on disks with room"
HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}  # typer's settings of a context
# Besides SIGINT. Windows has no SIGHUP.
ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


def run(command: "Callable[..., Any] | typer.Typer") -> None:
    """Run a command, or an application of several, on the arguments of this process.

    Ends it with SystemExit where the status is not 0: 2 for wrong arguments, 128 and the signal's number after a
    signal. While it runs, SIGTERM and SIGHUP clean up as Ctrl-C does, and libraries' warnings are not shown.
    """
    with (
        _ending_by_signals() as received,
        _own_streams(),
        _without_warnings(),
        _without_native_messages(),
        show_progress(),
    ):
        status = _status(as_application(command))
    if received and status == SIGNALLED + signal.SIGINT:  # typer takes each for Ctrl-C
        status = SIGNALLED + received[-1]
    if status:
        raise SystemExit(status)


def as_application(command: "Callable[..., Any] | typer.Typer") -> typer.Typer:
    """A function with typer's parameters as an application of that one command."""
    if isinstance(command, typer.Typer):
        return command
    app = typer.Typer(add_completion=False, context_settings=HELP_OPTIONS)
    app.command()(command)
    return app


def say(*lines: str) -> None:
    """Print lines, with control characters that names hold as escapes.

    Raises InputError if standard output cannot be written, and BrokenPipeError if its reader is gone.
    """
    try:
        print("\n".join(map(printable, lines)), flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise InputError(_unwritable(error)) from None


def literal(text: str) -> str:
    """Text for a rich table or status without markup; control characters are escaped."""
    from rich.markup import escape

    return escape(printable(text))


def warn(text: str) -> None:
    """Print one line on stderr, with control characters that names hold as escapes."""
    print(printable(text), file=sys.stderr)


def _status(app: typer.Typer) -> int:
    """Run the application; its exit status.

    InputError, OSError and MemoryError are printed as one line on stderr.
    """
    try:
        status = typer.main.get_command(app)(standalone_mode=False)
    except SystemExit as stop:
        status = stop.code
    except (KeyboardInterrupt, typer.Abort) as interrupt:
        status = SIGNALLED + getattr(interrupt, "signal_number", signal.SIGINT)
    except InputError as error:
        status = _fail(str(error))
    except MemoryError:
        status = _fail("memory ran out; give a smaller file, fewer or smaller images, or use a larger machine")
    except BrokenPipeError:  # the reader of the output has closed it
        status = BROKEN_PIPE
    except OSError as error:
        if error.strerror is None:  # not the system's
            raise
        where = f"{error.filename}: " if error.filename else ""
        status = _fail(f"{where}{error.strerror}; {SYSTEM_REMEDY}")
    except Exception as error:
        if not hasattr(error, "format_message"):  # only what is wrong with the arguments has a message of this kind
            raise
        status = _report_usage(error)
    return status if isinstance(status, int) else 0


def _fail(message: str) -> int:
    report_error(message)
    return EXIT_STATUS


def _report_usage(error: Any) -> int:
    """Say what is wrong with the arguments, or show the help where there are none; the exit status."""
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
    else:
        where = f"; {context.command_path} --help lists what it takes" if context else ""
        report_error(error.format_message().rstrip(".?") + where)
    return EXIT_STATUS


@contextlib.contextmanager
def _ending_by_signals() -> Iterator[list[int]]:
    """Let the signals that ask a process to end raise an exception, so that context managers clean up.

    Yields a list of those that came.
    """
    received: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise Terminated(number)

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    # What the caller ignores, as nohup does, stays ignored.
    taken = [number for number in ENDING_SIGNALS if signal.getsignal(number) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, end)
    try:
        yield received
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def _own_streams() -> Iterator[None]:
    """Standard streams that exist, take every character, and are written to the end.

    Exits if standard output cannot be written: with 2, or silently with 141 if its reader is gone.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        _flush_stdout()


def _flush_stdout() -> None:
    try:
        sys.stdout.flush()
    except OSError as error:
        # What could not be written is tried again when the interpreter ends: let it succeed then.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        if isinstance(error, BrokenPipeError):
            raise SystemExit(BROKEN_PIPE) from None
        report_error(_unwritable(error))
        raise SystemExit(EXIT_STATUS) from None


def _unwritable(error: OSError) -> str:
    return f"standard output cannot be written ({error.strerror}); lead it to where there is room"


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Without Python's warnings and the logging of libraries, unless python was called with -W."""
    silent = logging.NullHandler()
    logging.getLogger().addHandler(silent)
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore")
            yield
    finally:
        logging.getLogger().removeHandler(silent)


@contextlib.contextmanager
def _without_native_messages() -> Iterator[None]:
    """Hide what native libraries write to stderr, such as warnings of libpng and FFmpeg.

    They write to the file descriptor of stderr. It leads to a temporary file meanwhile, and Python's own stream to
    where it led before. The file's content is shown after an exception that is our mistake.
    """
    before = sys.stderr
    if not _writes_to(before, STDERR):
        yield
        return
    with tempfile.TemporaryFile() as held:
        before.flush()
        terminal = os.dup(STDERR)
        os.dup2(held.fileno(), STDERR)
        with os.fdopen(terminal, "w", 1, before.encoding, "backslashreplace", closefd=True) as ours:
            sys.stderr = ours
            faulthandler.enable(ours)  # a crash's own message is held, too
            try:
                yield
            except Exception:
                held.seek(0)
                ours.write(held.read().decode(errors="replace"))
                raise
            finally:
                faulthandler.disable()
                sys.stderr = before
                os.dup2(ours.fileno(), STDERR)


def _writes_to(stream: TextIO, descriptor: int) -> bool:
    try:
        return stream.fileno() == descriptor
    except (OSError, ValueError):  # not a file, or closed
        return False
