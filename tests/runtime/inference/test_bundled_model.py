"""The bundled model: complete, small, documented, and better than a constant depth."""

import numpy as np
import pytest
from idesplat import InputError, Predictor, read_cameras
from idesplat.runtime.inference import bundled_model as module
from idesplat.runtime.views.batch import build_view_batch

LARGEST = 16_000_000  # bytes


def test_is_small_and_says_what_it_was_trained_on():
    path = module.bundled_model()
    assert path.stat().st_size <= LARGEST
    own = Predictor(path).metadata
    assert (own.preset, own.height, own.width, own.near) == ("idesplat-lite", 256, 256, 1.0)
    assert own.trained_views == [2, 3] and own.trained_sides == [128, 256]
    assert own.fixed_views == 0 and not own.fixed_size


def test_damaged_or_missing_is_refused(tmp_path, monkeypatch):
    source = module.FOLDER
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    with pytest.raises(InputError, match=r"cannot be read .*install idesplat again"):
        module.bundled_model()
    for file in source.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert module.bundled_model() == tmp_path / module.NAME
    content = bytearray((tmp_path / module.NAME).read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / module.NAME).write_bytes(content)
    with pytest.raises(InputError, match=r"is damaged .*give --model"):
        module.bundled_model()


@pytest.mark.slow
def test_finds_depth_far_better_than_one_plane_does(scene):
    """On images of a synthetic room, its errors are less than half of those of the best constant depth."""
    cameras = read_cameras(scene / "transforms.json")
    pairs = [(scene / cameras[view].name, cameras[view]) for view in (1, 3)]
    height, width = cameras[0].height, cameras[0].width
    views = build_view_batch(pairs, None, height, width)
    predictor = Predictor(module.bundled_model())
    span = predictor.depth_range(views)
    found = predictor.predict_arrays(views.images, views.extrinsics, views.intrinsics, span.near, span.far).depth
    truth = np.stack([np.load(scene / "depth" / f"{view:03}.npz")["depth"] for view in (1, 3)])
    error = np.abs(found / truth - 1).mean()
    constants = np.linspace(truth.min(), truth.max(), 200)
    assert error < 0.5 * min(np.abs(constant / truth - 1).mean() for constant in constants)
