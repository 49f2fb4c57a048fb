"""The bundled graph and the weights that are kept for it belong together."""

from pathlib import Path

import numpy as np
import pytest
import torch
from idesplat.model.checkpoint import load_checkpoint
from idesplat.runtime.errors import InputError
from idesplat.runtime.inference.bundled_model import bundled_model
from idesplat.runtime.inference.predictor import Predictor
from idesplat.tools.synthetic.sampler import VALIDATION_SEEDS, generate_sample
from idesplat.tools.training.release import WEIGHTS, mean_weights, release_bundled_model

SIDE = 64
TYPICAL = 1e-5  # median error that float32 explains


@pytest.mark.slow
def test_the_bundled_graph_computes_what_its_weights_do() -> None:
    predictor = Predictor(bundled_model())
    sample = generate_sample(VALIDATION_SEEDS[0], 2, 0, SIDE, SIDE)
    views = sample.images, sample.extrinsics, sample.intrinsics
    found = predictor.predict_arrays(*views, sample.near, sample.far)
    near, far = (torch.full((2,), float(value)) for value in (sample.near, sample.far))
    with torch.no_grad():
        expected = load_checkpoint(WEIGHTS, predictor.metadata.preset)(*map(torch.from_numpy, views), near, far)
    assert np.median(np.abs(found.depth / expected.depth.numpy() - 1)) < TYPICAL
    opacities = expected.gaussians.opacities.numpy().ravel()
    assert np.median(np.abs(found.need_gaussians().opacities - opacities)) < TYPICAL


def test_unusable_checkpoints_and_presets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent"):
        release_bundled_model([tmp_path / "absent.ckpt"])
    with pytest.raises(InputError, match="--preset idesplat-huge: no such preset"):
        release_bundled_model([WEIGHTS], preset="idesplat-huge")


def test_networks_are_averaged_tensor_by_tensor() -> None:
    networks = [{"weight": torch.tensor([1.0, 2.0]), "bias": torch.tensor(3.0)}]
    networks += [{"weight": torch.tensor([3.0, -2.0]), "bias": torch.tensor(6.0)}]
    assert mean_weights(networks[:1])["weight"].tolist() == [1, 2]
    mean = mean_weights(networks)
    assert (mean["weight"].tolist(), mean["bias"].item()) == ([2, 0], 4.5)
