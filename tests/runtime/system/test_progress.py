"""Progress: the reports that a callback receives, and the bars that the commands show."""

import io
import sys

import pytest
from idesplat.runtime.cli.progress_bar import show_progress
from idesplat.runtime.system.progress import Progress, progress, reporting_to, working


def test_each_item_is_reported() -> None:
    reports: list[Progress] = []
    with reporting_to(reports.append):
        assert list(progress("ab", "reading")) == ["a", "b"]
    expected = [Progress("reading", done, 2) for done in range(3)]
    assert reports == [*expected, Progress("reading", 2, 2, ended=True)]


def test_interrupted_work_is_reported_as_ended() -> None:
    reports: list[Progress] = []
    with reporting_to(reports.append), pytest.raises(ZeroDivisionError), working("dividing"):
        raise ZeroDivisionError
    assert reports == [Progress("dividing", 0, None), Progress("dividing", 0, None, ended=True)]


def test_without_a_callback_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with working("dividing"):
        assert list(progress(iter("ab"), "reading", total=2)) == ["a", "b"]
    assert capsys.readouterr() == ("", "")


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("is_terminal", [True, False])
def test_commands_show_progress_on_terminals_only(monkeypatch: pytest.MonkeyPatch, is_terminal: bool) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal() if is_terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with show_progress():
        with working("loading [it]"):
            pass
        list(progress("ab", "reading"))
    printed = stream.getvalue()
    assert ("loading [it]" in printed, "reading" in printed) == (is_terminal, is_terminal)
