"""Compiled functions are kept where there is a folder for them, and the user is told while one is compiled."""

import numba
import pytest
from idesplat.runtime.system.compilation import compiled, compiling
from idesplat.runtime.system.progress import Progress, reporting_to

SAID = ["compiling a function, once on this computer"]


def double(x: float) -> float:
    return 2 * x


def told(function, number: float) -> list[str]:
    """What is said while the function is called."""
    reports: list[Progress] = []
    with reporting_to(reports.append), compiling(function, "a function"):
        assert function(number) == 2 * number
    return [report.description for report in reports if not report.ended]


def test_it_is_said_once(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    first = compiled()(double)
    assert told(first, 2.0) == SAID
    assert told(first, 2.0) == []
    assert told(compiled()(double), 3.0) == []


def test_without_a_folder_functions_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    njit = numba.njit

    def no_folder(*, cache: bool = False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_folder)
    assert told(compiled()(double), 2.5) == SAID
