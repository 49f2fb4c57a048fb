"""The reference cases' weights, which are generated: a tensor depends on its key, shape, seed and gain."""

import json
import zlib
from pathlib import Path

import numpy as np
import torch

FOLDER = Path(__file__).parent.parent / "data" / "reference"
# Tables and tokens, whose values are small whatever their shape.
SMALL = {"pos_embed", "cls_token", "mask_token", "k_pe", "v_pe", "rpe", "relative_position_bias_table"}


def random_tensor(key: str, shape: tuple[int, ...], seed: int, gain: float) -> np.ndarray:
    """The float32 tensor that a released checkpoint of the case would hold under `key`."""
    normal = np.random.default_rng([seed, zlib.crc32(key.encode())]).standard_normal(shape, dtype=np.float32)
    leaf = key.rpartition(".")[2]
    if leaf in SMALL:
        return 0.02 * normal
    if len(shape) >= 2:
        return gain * normal / np.sqrt(np.float32(np.prod(shape[1:])))
    if leaf in ("weight", "gamma"):
        return 1 + 0.1 * normal
    return 0.1 * normal


def random_state_dict(case: str) -> dict[str, torch.Tensor]:
    """All floating-point tensors of a case, under the keys of a released checkpoint without their `encoder.` prefix."""
    keys = json.loads((FOLDER / case / "state_dict_keys.json").read_text())
    weights = read_meta(case)["weights"]
    return {
        key: torch.from_numpy(np.ascontiguousarray(random_tensor(key, tuple(shape), **weights), np.float32))
        for key, (shape, dtype) in keys.items()
        if dtype == "float32"
    }


def read_meta(case: str) -> dict:
    """Configuration and strides of a case."""
    return json.loads((FOLDER / case / "meta.json").read_text())


def read_arrays(case: str) -> dict[str, torch.Tensor]:
    """Inputs and expected outputs of a case."""
    with np.load(FOLDER / case / "reference.npz") as file:
        return {name: torch.from_numpy(file[name]) for name in file.files}
