"""Loading checkpoints: strict, from every container, and never running what a pickle wants to run."""

import os
import pickle
import random
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from conftest import SMALL
from idesplat.model.checkpoint import (
    CheckpointError,
    file_sha256,
    fill,
    infer_preset,
    load_checkpoint,
    read_state_dict,
)
from idesplat.model.idesplat.keys import RENAMING, rename_released
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS
from reference_weights import random_state_dict
from safetensors.torch import save_file

CASE = "idesplat-re10k-2v-256x256"
# With as few tensors as it can have: these tests read and write them all, and run nothing.
FEW = replace(
    SMALL,
    transformer_layers=1,
    dpbus=tuple(replace(dpbu, unet=replace(dpbu.unet, levels=1)) for dpbu in SMALL.dpbus),
    residual_unet=replace(SMALL.residual_unet, levels=1),
)


@cache
def weights() -> dict[str, torch.Tensor]:
    return IDESplat(FEW).state_dict()


@pytest.fixture(scope="module")
def released():
    """Tensors of a released checkpoint's keys and shapes, all on the meta device but for their shape."""
    return {key: value.to("meta") for key, value in random_state_dict(CASE).items()}


@pytest.mark.parametrize("nest", (lambda d: d, lambda d: {"state_dict": d, "epoch": 3}, lambda d: {"model": d}))
def test_containers(tmp_path, nest):
    tensors = weights()
    path = tmp_path / "weights.ckpt"
    torch.save(nest(tensors), path)
    loaded = load_checkpoint(path, FEW).state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in tensors.items())


def test_safetensors(tmp_path):
    path = tmp_path / "weights.safetensors"
    save_file(weights(), path)
    assert load_checkpoint(path, FEW)


def test_released_files_lose_their_prefix_and_what_belongs_to_the_loss(tmp_path):
    ours, loss = {"encoder.depth_predictor.conv_mv.bias": torch.zeros(2)}, {"losses.lpips.weight": torch.zeros(3)}
    torch.save({"state_dict": {**ours, **loss}}, tmp_path / "weights.ckpt")
    assert list(rename_released(read_state_dict(tmp_path / "weights.ckpt"))) == ["dpbu1.merge.conv.bias"]


@pytest.mark.parametrize("name", ("re10k", "acid", "dl3dv"))
def test_the_file_name_decides_between_presets_of_one_shape(released, name):
    assert infer_preset(Path(f"idesplat-{name}-256x256-view2.ckpt"), released) == f"idesplat-{name}"


def test_an_ambiguous_file_lists_the_presets_that_fit(released):
    with pytest.raises(CheckpointError, match=r"idesplat-re10k, idesplat-acid, idesplat-dl3dv.*--preset"):
        infer_preset(Path("mine.ckpt"), released)


def test_names_are_mapped_one_to_one(released):
    used = [key for key in released if not RENAMING.unused.search(key)]
    assert len({RENAMING.rename_key(key) for key in used}) == len(used)


def test_a_missing_an_unknown_and_a_misshapen_tensor_are_named():
    model = IDESplat(FEW)
    tensors = model.state_dict()
    del tensors["encoder.backbone.conv1.weight"]
    tensors["encoder.new.weight"] = torch.zeros(1)
    tensors["gaussians.head1.bias"] = torch.zeros(5)
    with pytest.raises(CheckpointError) as error:
        fill(model, tensors, Path("file.pth"))
    message = str(error.value)
    for part in (
        "file.pth",
        "encoder.backbone.conv1.weight is missing",
        "encoder.new.weight is unknown",
        "gaussians.head1.bias",
    ):
        assert part in message
    assert "\n" not in message


def test_a_transposed_tensor_is_refused():
    model = IDESplat(FEW)
    tensors = {k: v.T if k == "encoder.transformer.layers.0.mlp1.weight" else v for k, v in model.state_dict().items()}
    with pytest.raises(CheckpointError, match=r"mlp1\.weight has shape"):
        fill(model, tensors, Path("file.pth"))


class Harmful:
    """Would create a file if it were unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("write", (torch.save, lambda content, path: path.write_bytes(pickle.dumps(content))))
def test_a_pickle_that_runs_code_is_refused_with_an_explanation(tmp_path, write):
    write({"state_dict": Harmful(tmp_path / "harm")}, tmp_path / "evil.ckpt")
    with pytest.raises(CheckpointError, match=r"evil\.ckpt.*any code") as error:
        read_state_dict(tmp_path / "evil.ckpt")
    assert not (tmp_path / "harm").exists()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ("broken.ckpt", "broken.pth", "broken.safetensors"))
@pytest.mark.parametrize("content", (b"", b"not a checkpoint", b"PK\x03\x04" + bytes(64)))
def test_unreadable_files_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=name) as error:
        read_state_dict(tmp_path / name)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_file_without_tensors(tmp_path):
    with pytest.raises(CheckpointError, match="no such file"):
        read_state_dict(tmp_path / "none.ckpt")
    torch.save({"epoch": 3}, tmp_path / "empty.ckpt")
    with pytest.raises(CheckpointError, match="no tensors"):
        read_state_dict(tmp_path / "empty.ckpt")


# ---- invalid contents: each is refused in one line, by CheckpointError


def _replaced(value):
    """The small network's state dict with one tensor replaced."""
    return {**weights(), "dpbu1.merge.conv.bias": value}


ODD_CONTENTS = {
    "a key that is a number": (lambda: {7: torch.zeros(2)}, "key of type int"),
    "a key that is a tuple": (lambda: {("a", "b"): torch.zeros(2)}, "key of type tuple"),
    "a key of bytes among text": (lambda: {"a": torch.zeros(2), b"b": torch.zeros(2)}, "key of type bytes"),
    "an empty key": (lambda: {"": torch.zeros(2)}, "does not fit"),
    "a key of many lines": (
        lambda: {**weights(), "a\nb\x1b[2J\udcff": torch.zeros(2)},
        r"'a\nb\x1b[2J\udcff' is unknown",
    ),
    "sparse": (lambda: _replaced(torch.eye(64).to_sparse()), "is sparse"),
    "compressed sparse": (lambda: _replaced(torch.eye(64).to_sparse_csr()), "is sparse"),
    "without values": (lambda: _replaced(torch.empty(64, device="meta")), "without values"),
    "quantized": (lambda: _replaced(torch.quantize_per_tensor(torch.zeros(64), 0.1, 0, torch.qint8)), "is quantized"),
    "integers": (lambda: _replaced(torch.zeros(64, dtype=torch.int64)), "holds torch.int64"),
    "complex": (lambda: _replaced(torch.zeros(64, dtype=torch.complex64)), "holds torch.complex64"),
    "truth values": (lambda: _replaced(torch.zeros(64, dtype=torch.bool)), "holds torch.bool"),
    "NaN": (lambda: _replaced(torch.full((64,), torch.nan)), "dpbu1.merge.conv.bias holds NaN or infinity"),
    "infinity": (lambda: _replaced(torch.full((64,), torch.inf)), "holds NaN or infinity"),
    "a list": (lambda: [torch.zeros(2)], "holds a list"),
    "text": (lambda: "hello", "holds a str"),
    "nothing": (lambda: None, "holds a NoneType"),
    "far more values than bytes": (lambda: _replaced(torch.zeros(1).expand(1 << 40)), "has shape (1099511627776,)"),
}


@pytest.mark.parametrize("legacy", (False, True))
@pytest.mark.parametrize("name", ODD_CONTENTS)
def test_odd_contents_are_refused_in_one_line(tmp_path, name, legacy, recwarn):
    make, expected = ODD_CONTENTS[name]
    path = tmp_path / "odd.pth"
    torch.save(make(), path, _use_new_zipfile_serialization=not legacy)
    recwarn.clear()
    with pytest.raises(CheckpointError) as error:
        load_checkpoint(path, FEW)
    message = str(error.value)
    assert expected in message and "odd.pth" in message
    assert message.isprintable() and len(message) < 800
    assert not recwarn.list


def test_half_precision_is_taken(tmp_path):
    tensors = {key: value.half() for key, value in weights().items()}
    torch.save(tensors, tmp_path / "half.pth")
    assert next(load_checkpoint(tmp_path / "half.pth", FEW).parameters()).dtype == torch.float32


def test_a_tensor_with_attributes_of_its_own_is_used_as_a_tensor(tmp_path):
    """A file may give a parameter any attribute, also one that hides a method of tensors."""
    tensors = weights()
    weight = torch.nn.Parameter(tensors["dpbu1.merge.conv.bias"])
    weight.reshape = weight.isfinite = weight.squeeze = "text"
    torch.save({**tensors, "dpbu1.merge.conv.bias": weight}, tmp_path / "odd.pth")
    assert load_checkpoint(tmp_path / "odd.pth", FEW)


@pytest.mark.parametrize("legacy", (False, True))
def test_damaged_files_raise_nothing_else(tmp_path, legacy):
    """Truncated, and with bytes replaced: PyTorch raises whatever its unpickler meets."""
    path = tmp_path / "damaged.pth"
    torch.save({"a": torch.zeros(3), "b": {"c": torch.ones(2)}}, path, _use_new_zipfile_serialization=not legacy)
    whole = path.read_bytes()
    rng = random.Random(0)
    for attempt in range(300):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content[: rng.randrange(len(content))] if attempt % 3 == 0 else content)
        try:
            read_state_dict(path)
        except CheckpointError as error:
            assert str(error).isprintable()


@pytest.mark.parametrize("name", ["input_blocks", "output_blocks"])
def test_a_key_with_a_number_that_is_too_long_is_unknown(tmp_path, name):
    torch.save({f"depth_predictor.{name}.{'9' * 5000}.0.weight": torch.zeros(1)}, tmp_path / "long.pth")
    with pytest.raises(CheckpointError, match=f"{name}.*is unknown|fits none of the presets"):
        load_checkpoint(tmp_path / "long.pth")


def test_a_packed_archive_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "packed.pth"
    torch.save({"a": torch.zeros(1 << 20)}, tmp_path / "plain.pth")
    with zipfile.ZipFile(tmp_path / "plain.pth") as plain, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    with pytest.raises(CheckpointError, match="claims to hold"):
        read_state_dict(path)


@pytest.mark.posix
@pytest.mark.parametrize("read", (read_state_dict, file_sha256))
def test_a_named_pipe_and_a_name_that_is_too_long_are_refused(tmp_path, read):
    os.mkfifo(tmp_path / "pipe.pth")
    for path, expected in ((tmp_path / "pipe.pth", "not a regular file"), (tmp_path / ("a" * 300), "cannot be read")):
        with pytest.raises(CheckpointError, match=expected):
            read(path)


def test_every_preset_can_be_told_from_its_released_name(released):
    """Names as the releases write them; only IDESplat's shapes are held here."""
    assert [name for name in PRESETS if name.startswith("idesplat-")][:3] == [
        "idesplat-re10k",
        "idesplat-acid",
        "idesplat-dl3dv",
    ]
