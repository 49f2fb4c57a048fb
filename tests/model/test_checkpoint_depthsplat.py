"""DepthSplat's checkpoints: which preset a file is, depth-only files, and the hash that a name holds."""

import hashlib
import json

import pytest
import torch
from idesplat.model import checkpoint
from idesplat.model.depthsplat.network import DepthSplatDepth
from idesplat.model.registry import PRESETS, build
from reference_weights import FOLDER

RELEASED = {
    "depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth": "depthsplat-small-re10k",
    "depthsplat-gs-base-re10k-256x256-view2-ca7b6795.pth": "depthsplat-base-re10k",
    "depthsplat-gs-base-re10k-256x448-view2-fea94f65.pth": "depthsplat-base-re10k-256x448",
    "depthsplat-gs-base-dl3dv-256x448-randview2-6-02c7b19d.pth": "depthsplat-base-dl3dv",
    "depthsplat-gs-small-re10kdl3dv-448x768-randview4-10-c08188db.pth": "depthsplat-small-re10kdl3dv",
    "depthsplat-gs-base-re10kdl3dv-448x768-randview2-6-f8ddd845.pth": "depthsplat-base-re10kdl3dv",
    "depthsplat-depth-small-352x640-randview2-8-e807bd82.pth": "depthsplat-depth-small",
    "depthsplat-depth-base-352x640-randview2-8-65a892c5.pth": "depthsplat-depth-base",
}
# Inputs of the three joining convolutions where the coarsest feature map is at an eighth of the image size, with the
# inverse depth that joins in the depth upsampler: CNN, ViT, matching features.
EIGHTH = {
    "small": ([64 + 48, 96 + 96, 128 + 192 + 128], 2),
    "base": ([64 + 96, 96 + 192 + 64, 128 + 384 + 128], 1),
}


def released(name):
    """Empty tensors under the keys of the released file of that name."""
    size = "small" if "-small-" in name else "base"
    keys = json.loads((FOLDER / f"depthsplat-{size}-2v-256x256" / "state_dict_keys.json").read_text())
    shapes = {key: shape for key, (shape, _) in keys.items()}
    if not name.endswith(("cfeab6b1.pth", "ca7b6795.pth")):
        inputs, depth_level = EIGHTH[size]
        for upsampler in ("depth_predictor.upsampler", "feature_upsampler"):
            for level, count in enumerate(inputs):
                joined = count + (level == depth_level and upsampler != "feature_upsampler")
                shapes[f"{upsampler}.concat_projects.{level}.weight"][1] = joined
    if "-depth-" in name:
        prefix = "depth_predictor."
        shapes = {key.removeprefix(prefix): shape for key, shape in shapes.items() if key.startswith(prefix)}
        return {"model": {key: torch.empty(shape).fill_(0.5) for key, shape in shapes.items()}}
    return {f"encoder.{key}": torch.empty(shape, device="meta") for key, shape in shapes.items()}


@pytest.mark.parametrize("name", RELEASED)
def test_preset_of_released_names(name, tmp_path):
    tensors = released(name)
    if "model" in tensors:
        tensors = {f"depth_predictor.{key}": value for key, value in tensors["model"].items()}
    tensors = {key.removeprefix("encoder."): value for key, value in tensors.items()}
    assert checkpoint.infer_preset(tmp_path / name, tensors) == RELEASED[name]


def test_name_that_does_not_decide(tmp_path):
    tensors = {key.removeprefix("encoder."): value for key, value in released("depthsplat-gs-base-dl3dv").items()}
    with pytest.raises(checkpoint.CheckpointError, match=r"fits the presets .*base-dl3dv.*choose with --preset"):
        checkpoint.infer_preset(tmp_path / "mine.pth", tensors)


def test_depth_only_file(tmp_path):
    path = tmp_path / "depthsplat-depth-small-mine.pth"
    torch.save(released(path.name), path)
    tensors = checkpoint.read_state_dict(path)
    preset = checkpoint.infer_preset(path, tensors)
    model = build(preset)
    assert isinstance(model, DepthSplatDepth) and not PRESETS[preset].gaussians
    checkpoint.fill(model, tensors, path)
    assert all((value == 0.5).all() for value in model.state_dict().values())


def test_gaussian_file_does_not_fit_the_depth_only_network(tmp_path):
    tensors = {key.removeprefix("encoder."): value for key, value in released("depthsplat-gs-small-8").items()}
    with pytest.raises(checkpoint.CheckpointError, match=r"does not fit the network: gaussians\.\S+ is unknown"):
        checkpoint.fill(build("depthsplat-depth-small"), tensors, tmp_path / "x.pth")


def test_hash_in_the_name(tmp_path):
    digest = hashlib.sha256(b"weights").hexdigest()[:8]
    for name, fits in ((f"depthsplat-{digest}.pth", True), ("depthsplat-00000000.pth", False), ("mine.pth", True)):
        path = tmp_path / name
        path.write_bytes(b"weights")
        warning = checkpoint.name_hash_warning(path, checkpoint.file_sha256(path))
        assert (warning is None) == fits
        assert fits or (digest in warning and "00000000" in warning and str(path) in warning)
