"""DepthSplat against the release's arrays, in PyTorch and in ONNX Runtime; the numbers of docs/parity.md.

python tests/measure_parity.py
"""

import tempfile
from pathlib import Path

import torch
from idesplat.export.cli import describe
from idesplat.export.exporter import Fixed, freeze
from idesplat.export.stages import NamedTensors
from idesplat.model.checkpoint import fill
from idesplat.model.gaussian_adapter import WorldGaussians
from idesplat.model.networks import build
from idesplat.runtime.bundle import INPUTS
from idesplat.runtime.session import open_session, run_session
from reference_weights import draw_state_dict, read_arrays, read_meta
from test_reference import as_reference
from test_reference_depthsplat import CASES


def report(what: str, depth: torch.Tensor, gaussians: list[torch.Tensor], case: str) -> None:
    expected, step = read_arrays(case), read_meta(case)["gaussian_stride"]
    error = (depth - expected["depth"]).abs() / expected["depth"]
    kept = [x.unflatten(0, depth.shape)[:, ::step, ::step].flatten(0, 2) for x in gaussians]
    pairs = as_reference(WorldGaussians(*kept), expected).values()
    worst = max(float((ours - reference).abs().max() / reference.std()) for ours, reference in pairs)
    share = 100 * (error <= 1e-3).double().mean()
    print(f"{what:40s} {share:.2f} %, median {error.median():.1e}, largest {error.max():.1e}, Gaussians {worst:.1e}")


@torch.no_grad()
def main() -> None:
    for case, preset in CASES.items():
        model = build(preset).eval()
        fill(model, draw_state_dict(case), Path(case))
        arrays = read_arrays(case)
        inputs = [arrays["image"] / 255, *(arrays[name] for name in INPUTS[1:])]
        predicted = model(*inputs)
        report(f"{case}, PyTorch", predicted.depth, list(predicted.gaussians), case)
        with tempfile.TemporaryDirectory() as folder:
            graphs = freeze(NamedTensors(model), describe(model, "", "", "", Fixed()), Fixed(), Path(folder))
            feeds = {name: value.numpy() for name, value in zip(INPUTS, inputs, strict=True)}
            found = {name: torch.from_numpy(x) for name, x in run_session(open_session(graphs.whole), feeds).items()}
        report(f"{case}, ONNX Runtime", found["depth"], [found[name] for name in WorldGaussians._fields], case)


if __name__ == "__main__":
    main()
