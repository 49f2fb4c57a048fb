"""Scenes without Gaussians, and values at the limits of a format."""

from pathlib import Path

import numpy as np
import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.splats.formats.encoding import clipped_note
from idesplat.runtime.splats.formats.ply import read_ply, write_ply
from idesplat.runtime.splats.gaussians import Gaussians
from idesplat.runtime.splats.io import read_offset, write_splats

NONE = Gaussians(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (3,), (4,), (), (1, 3))))


def test_points_without_any_are_refused_by_glb(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot write .*a\.points\.glb: there are no points"):
        write_splats(tmp_path / "a.points.glb", NONE)
    assert not list(tmp_path.iterdir())


def test_values_at_a_limit_are_not_clipped() -> None:
    low, high = np.exp(-10.0), np.exp(5.9375)
    at_limits = np.float32([low, high])
    assert clipped_note("scales", np.nextafter(at_limits, np.float32([0, 1e9])), low, high) == []
    assert clipped_note("scales", 1.001 * at_limits, low, high) == [
        f"1 of 2 scales outside {low:.3g} to {high:.3g} were clipped"
    ]


def test_an_offset_behind_a_blank_line_of_the_header_is_read(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", NONE)
    content = (tmp_path / "a.ply").read_bytes()
    start, rest = content.split(b"\n", 1)
    (tmp_path / "b.ply").write_bytes(start + b"\n\ncomment offset 1 2 3\n" + rest)
    assert len(read_ply(tmp_path / "b.ply")) == 0
    np.testing.assert_array_equal(read_offset(tmp_path / "b.ply"), [1, 2, 3])
