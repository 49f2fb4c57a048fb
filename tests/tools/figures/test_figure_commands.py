"""The commands that draw the figures of the documentation."""

import pytest
from conftest import run_command
from idesplat.tools.figures import capture_figures, conventions


@pytest.mark.parametrize("module", [capture_figures, conventions])
def test_a_wrong_option_is_one_line(module, capsys):
    assert run_command(module.main, "--nothing") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: No such option: --nothing")
    assert printed.count("\n") == 1
