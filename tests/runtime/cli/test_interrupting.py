"""Ctrl-C during a refinement ends it; before and after, it means what it meant."""

import signal

import pytest
from idesplat.runtime.cli.interrupting import StopOnInterrupt


def test_it_stops_the_steps_and_leaves_the_signal_as_it_was() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopOnInterrupt() as on_step:
        assert signal.getsignal(signal.SIGINT) is before
        assert on_step(0, 20.0)
        signal.raise_signal(signal.SIGINT)
        assert on_step.stopped and not on_step(1, 20.0)
    assert signal.getsignal(signal.SIGINT) is before


def test_before_the_first_step_it_aborts() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), StopOnInterrupt():
        signal.raise_signal(signal.SIGINT)
