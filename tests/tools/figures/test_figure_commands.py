"""The commands that draw the figures of the documentation."""

import numpy as np
import pytest
from conftest import run_command
from idesplat.runtime.cameras.camera import Camera
from idesplat.tools.figures import capture_figures, conventions


@pytest.mark.parametrize("module", [capture_figures, conventions])
def test_a_wrong_option_is_one_line(module, capsys):
    assert run_command(module.main, "--nothing") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: No such option: --nothing")
    assert printed.count("\n") == 1


def test_renders_that_stand_side_by_side_are_of_one_size():
    first, other = (Camera("", *size, np.diag([600.0, 600, 1]), np.eye(4)) for size in ((960, 630), (959, 632)))
    shown = capture_figures.small_cameras(first, other)
    assert [(camera.width, camera.height) for camera in shown] == [(384, 252), (384, 252)]
    np.testing.assert_allclose(shown[1].K, np.diag([600 * 384 / 959, 600 * 252 / 632, 1]))
