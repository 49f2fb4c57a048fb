"""Progress on stderr, where that is a terminal: a bar for counted work, a spinner for other work."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..errors import printable
from ..system.progress import Progress, reporting_to

if TYPE_CHECKING:
    from rich import progress as rich_progress
    from rich.status import Status


@contextmanager
def show_progress() -> Iterator[None]:
    """Show the progress of the work in the block, where stderr is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    display = _Display()
    with reporting_to(display.update):
        try:
            yield
        finally:
            display.stop()


class _Display:
    """The bars and spinners of the work in progress, by its description."""

    def __init__(self) -> None:
        self._shown: dict[str, rich_progress.Progress | Status] = {}

    def update(self, work: Progress) -> None:
        """Show a report."""
        if work.ended:
            if shown := self._shown.pop(work.description, None):
                shown.stop()
        elif work.total is not None:
            self._update_bar(work)
        elif work.description not in self._shown:
            self._start_spinner(work.description)

    def stop(self) -> None:
        """Remove bars and spinners that interrupted work left."""
        while self._shown:
            self._shown.popitem()[1].stop()

    def _update_bar(self, work: Progress) -> None:
        from rich import progress
        from rich.console import Console

        bar = self._shown.get(work.description)
        if not isinstance(bar, progress.Progress):
            columns = (
                progress.TextColumn("[progress.description]{task.description}"),
                progress.BarColumn(),
                progress.TaskProgressColumn(show_speed=True),
                progress.TimeRemainingColumn(elapsed_when_finished=True),
                progress.TextColumn("{task.fields[detail]}"),
            )
            bar = self._shown[work.description] = progress.Progress(
                *columns, console=Console(stderr=True), transient=True
            )
            bar.add_task(_literal(work.description), total=work.total, detail="")
            bar.start()
        bar.update(bar.task_ids[0], completed=work.done, detail=_literal(work.detail))

    def _start_spinner(self, description: str) -> None:
        from rich.console import Console

        spinner = self._shown[description] = Console(stderr=True).status(_literal(description))
        spinner.start()


def _literal(text: str) -> str:
    from rich.markup import escape

    return escape(printable(text))
