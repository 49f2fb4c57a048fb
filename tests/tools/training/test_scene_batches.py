"""Several scenes in one pass of the network, and what makes a GPU faster: the same losses and gradients."""

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from idesplat.model.idesplat.config import PhotoConfig
from idesplat.model.idesplat.network import IDESplat
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.header import DamagedImage
from idesplat.tools.training.data.samples import (
    SampleSpec,
    TrainingViews,
    prefetch,
    prefetch_in_processes,
    stack_scenes,
)
from idesplat.tools.training.data.synthetic import generate_views
from idesplat.tools.training.gather_attention import use_training_gather_attention
from idesplat.tools.training.objectives.consistency import with_matches
from idesplat.tools.training.options import Device, Objective, OptionalTerms, Resources
from idesplat.tools.training.run_files import CHECKPOINT
from idesplat.tools.training.schedule import Phase
from idesplat.tools.training.step import scene_loss
from idesplat.tools.training.trainer import train
from test_train import SETTINGS, SMALL

DEPTH = Phase(1.0, dpbus=3, gaussians=False, downsample=1)
ALL = replace(DEPTH, gaussians=True)
# A pass of these scenes in a process whose numba simulates a GPU.
SIMULATED = """
import numpy as np
from idesplat.tools.training.cuda_scatter import scatter_kernel

rng = np.random.default_rng(0)
weights, pixels = rng.random((20, 11)), rng.standard_normal((20, 6))
rows = rng.integers(0, 4, (20, 11)).repeat(2, axis=1)[:, :11].astype(np.int32)
expected, found = np.zeros((4, 6)), np.zeros((4, 6))
np.add.at(expected, rows, weights[:, :, None] * pixels[:, None])
scatter_kernel[3, (4, 8)](weights, pixels, rows, found)
np.testing.assert_allclose(found[:-1], expected[:-1])
assert not found[-1].any()  # the row of "outside"
"""


@pytest.fixture(scope="module")
def network() -> Iterator[IDESplat]:
    """A small network, with one PyTorch thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield use_training_gather_attention(IDESplat(replace(SMALL, photo=PhotoConfig(), cross_view_channels=8)))
    torch.set_num_threads(threads)


@pytest.mark.parametrize("phase, views", ((DEPTH, 2), (DEPTH, 4), (ALL, 3)))
def test_several_scenes_have_the_mean_loss_and_gradient_of_each(network: IDESplat, phase: Phase, views: int) -> None:
    objective = Objective.BOTH if phase.gaussians else Objective.DEPTH
    terms = OptionalTerms(consistency=0.01 * phase.gaussians)
    scenes = [
        with_matches(generate_views, SampleSpec(seed, views, (1, 2) * phase.gaussians, 64, 64)) for seed in (3, 4, 5)
    ]
    apart = [scene_loss(network, scene, phase, objective, None, 1, terms) for scene in scenes]
    alone = _gradients(network, sum(loss for loss, _ in apart) / len(scenes))
    loss, entry = scene_loss(network, stack_scenes(scenes), phase, objective, None, 1, terms)
    together = _gradients(network, loss)
    for name, value in entry.items():
        assert value == pytest.approx(np.mean([of_scene[name] for _, of_scene in apart]), rel=1e-3), name
    norm = torch.cat([gradient.flatten() for gradient in alone]).norm()
    difference = torch.cat([(a - b).flatten() for a, b in zip(alone, together, strict=True)]).norm()
    assert difference < 1e-3 * norm


def _gradients(network: IDESplat, loss: torch.Tensor) -> list[torch.Tensor]:
    parameters = [p for p in network.parameters() if p.requires_grad]
    found: Iterable[torch.Tensor | None] = torch.autograd.grad(loss, parameters, allow_unused=True)
    return [torch.zeros_like(p) if part is None else part for p, part in zip(parameters, found, strict=True)]


def test_the_gradient_of_the_table_on_a_simulated_gpu() -> None:
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}
    subprocess.run([sys.executable, "-P", "-c", SIMULATED], env=environment, check=True)


def test_processes_load_the_samples_of_a_thread_in_order() -> None:
    specs = [SampleSpec(seed, 2, (), 64, 64) for seed in range(5)]
    threaded = list(prefetch(iter(specs), generate_views))
    loaded = list(prefetch_in_processes(specs, generate_views, 2))
    assert len(loaded) == len(threaded) == 5
    assert all(torch.equal(a.images, b.images) for a, b in zip(loaded, threaded, strict=True))


@pytest.mark.slow
def test_run_with_loaders_ends_at_the_same_weights(tmp_path: Path) -> None:
    settings = replace(SETTINGS, curriculum=False, steps=2, batch=2)
    weights = []
    for loaders in (0, 1):
        folder = tmp_path / str(loaders)
        folder.mkdir()
        train(settings, folder, config=SMALL, resources=Resources(loaders=loaders), save_every=1e9, validate_every=10)
        weights.append(torch.load(folder / CHECKPOINT, weights_only=True)["state_dict"])
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


@pytest.mark.parametrize(
    "options, changes, message",
    (
        ({"together": 2}, {}, "the ViT takes one scene at a time"),
        ({"together": 2}, {"data": ["capture"], "real_ratio": 0.5}, "takes synthetic scenes alone"),
        ({"device": Device.CUDA}, {"pm_loss": 0.005}, "--pm-loss is computed on the CPU alone"),
        ({"device": Device.CUDA}, {"aperture": 0.02}, "--lens-diameter is computed on the CPU alone"),
        ({"loaders": 2, "processes": 2}, {}, "need a single process that trains"),
    ),
)
def test_options_that_cannot_be_used_are_refused(
    tmp_path: Path, options: dict[str, Any], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train(replace(SETTINGS, batch=2, **changes), tmp_path, config=SMALL, resources=Resources(**options))


def _damaged(spec: SampleSpec) -> TrainingViews:
    raise DamagedImage(Path("frame.jpg"), "cannot be decoded")


def test_the_error_of_a_loader_keeps_its_message() -> None:
    with pytest.raises(InputError, match=r"^frame\.jpg: cannot be decoded$"):
        next(prefetch_in_processes([SampleSpec(1, 2, (), 64, 64)], _damaged, 1))
