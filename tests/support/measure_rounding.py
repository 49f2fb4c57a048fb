"""How far rounding alone moves IDESplat's depth with random weights; the numbers of docs/parity.md.

PYTHONPATH=tests/support python -P tests/support/measure_rounding.py
"""

from pathlib import Path

import torch
from idesplat.model.checkpoint import fill
from idesplat.model.idesplat.network import IDESplat
from idesplat.model.registry import PRESETS
from reference_weights import random_state_dict, read_arrays

CASE = "idesplat-re10k-2v-256x256"
ULP = 6e-8


def report(what: str, depth: torch.Tensor, against: torch.Tensor) -> None:
    """Print how many depths agree, and the median relative error."""
    error = (depth.double() - against.double()).abs() / against.double()
    print(f"{what:55s} {100 * (error <= 1e-3).double().mean():6.2f} % within 1e-3, median {error.median():.1e}")


@torch.no_grad()
def main() -> None:
    """Measure each kind of rounding in turn."""
    model = IDESplat(PRESETS["idesplat-re10k"]).eval()
    fill(model, random_state_dict(CASE), Path(CASE))
    arrays = read_arrays(CASE)
    inputs = [arrays["image"] / 255, *(arrays[name] for name in ("extrinsics", "intrinsics", "near", "far"))]
    torch.set_num_threads(2)
    depth = model(*inputs).depth
    report("this network against the reference, end to end", depth, arrays["depth"])
    noise = torch.randn(inputs[0].shape, generator=torch.Generator().manual_seed(0))
    report("images changed by a unit in the last place", model(inputs[0] * (1 + ULP * noise), *inputs[1:]).depth, depth)
    torch.set_num_threads(1)
    report("one thread instead of two", model(*inputs).depth, depth)
    torch.set_num_threads(2)
    precise = model.double()(*(value.double() for value in inputs)).depth
    report("the reference against this network in float64", arrays["depth"], precise)


if __name__ == "__main__":
    main()
