"""The table of supported checkpoints: every released preset, as rows of Markdown."""

import re

import torch
from conftest import run_command
from idesplat.model.registry import PRESETS, build
from idesplat.tools.figures.checkpoint_table import COLUMNS, RELEASED, Measured, main, randomize_weights, row


def test_every_released_preset_has_its_row():
    assert {name for name in PRESETS if re.search("re10k|acid|dl3dv|-depth-", name)} == set(RELEASED)
    found = Measured(354_337_760, 1.0, 3e-7, 12.34, int(4.2e9), int(1.42e9), 136.0, int(6.2e9))
    for name in RELEASED:
        cells = row(name, found).split(" | ")
        assert len(cells) == len(COLUMNS)
        assert f"`{name}`" in cells
    assert "| 354.3 M | 256x256 | 2 | 100.00 % (3e-07) | 12.3 | 4.2 GB | 1.42 GB | 136 s, 6.2 GB |" in row(
        "depthsplat-large-re10k", found
    )


def test_random_weights_are_reproducible_and_reach_every_parameter():
    first, second = build("idesplat-tiny"), build("idesplat-tiny")
    randomize_weights(first)
    randomize_weights(second)
    for (name, parameter), other in zip(first.named_parameters(), second.parameters(), strict=True):
        assert torch.equal(parameter, other), name
        assert parameter.numel() == 1 or parameter.std() > 0, name


def test_an_unknown_preset_is_one_line(capsys, monkeypatch):
    assert run_command(main, "nonsense") == 2
    assert "choose of idesplat-re10k" in capsys.readouterr().err
