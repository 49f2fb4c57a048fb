"""A batch on Ray that is killed at random moments; the command kills more often."""

import shutil
from pathlib import Path

import pytest
from idesplat.tools.benchmark.batch_kills import check_kills
from tiny_model import write_model

MOMENTS = 3


@pytest.mark.slow
@pytest.mark.posix
def test_a_batch_that_is_killed_ends_as_an_undisturbed_one(scene: Path, tmp_path: Path) -> None:
    for name in "abcd":
        shutil.copytree(scene, tmp_path / "scenes" / name)
    told: list[str] = []
    check_kills(tmp_path / "scenes", tmp_path, MOMENTS, 0, write_model(tmp_path / "tiny.onnx"), tell=told.append)
    assert len(told) > MOMENTS
