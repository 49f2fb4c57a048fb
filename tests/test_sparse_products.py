"""The sparse products that training and the export put in place of the network's own: the same values and gradients."""

import numpy as np
import onnx
import onnxruntime
import torch
from idesplat.export.sparse_products import FEW, explain, in_steps
from idesplat.export.stages import names_read
from idesplat.model import sparse_products as gathered
from idesplat.model.sparse_products import SparseProducts
from idesplat.tools import sparse_products as compiled

PAIRS, CANDIDATES, PIXELS, CHANNELS = 4, 11, 30, 6


def test_values_and_gradients_are_the_networks_own() -> None:
    torch.manual_seed(0)
    rows = torch.randint(0, PAIRS * PIXELS + 1, (PAIRS, CANDIDATES, PIXELS))  # the last row is of zeros
    queries, weights = torch.randn(PAIRS, PIXELS, CHANNELS), torch.rand(PAIRS, CANDIDATES, PIXELS)
    table = gathered.pixel_table(torch.randn(PAIRS, PIXELS, CHANNELS))
    for name, left in (("correlate", queries), ("weigh", weights)):
        results = []
        for module in (gathered, compiled):
            inputs = [part.clone().requires_grad_() for part in (left, table)]
            product = getattr(module, name)(*inputs, rows)
            gradients = torch.autograd.grad(product.square().sum(), inputs)
            results.append((product, *gradients))
        for expected, found in zip(*results, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


class Both(torch.nn.Module):
    """One product after the other."""

    def __init__(self, gathers: int) -> None:
        super().__init__()
        self.products = SparseProducts(gathers)

    def forward(self, queries: torch.Tensor, table: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return self.products.weigh(self.products.correlate(queries, table, rows), table, rows)


def exported(gathers: int, arguments: tuple[torch.Tensor, ...], path: str) -> onnx.ModelProto:
    """`Both` as a graph whose pairs and pixels are open."""
    network = Both(gathers)
    axes = {"queries": {0: "pairs", 1: "pixels"}, "table": {0: "all"}, "rows": {0: "pairs", 2: "pixels"}}
    with in_steps(network):
        torch.onnx.export(network, arguments, path, dynamo=False, input_names=list(axes), dynamic_axes=axes)
    assert network.products.correlate is gathered.correlate  # put back
    return explain(onnx.load(path))


def test_exported_values_are_the_networks_own(tmp_path) -> None:
    generator = torch.Generator().manual_seed(0)

    def drawn(pairs: int, pixels: int) -> tuple[torch.Tensor, ...]:
        rows = torch.randint(0, 2 * pixels, (pairs, CANDIDATES, pixels), generator=generator, dtype=torch.int32)
        queries = torch.randn(pairs, pixels, CHANNELS, generator=generator)
        return queries, torch.randn(2 * pixels, CHANNELS, generator=generator), rows

    model = exported(FEW, drawn(2, 32), str(tmp_path / "both.onnx"))
    onnx.checker.check_model(model, full_check=True)
    assert [node.op_type for node in model.graph.node].count("Loop") == 2
    assert {node.domain for node in model.graph.node} == {""}
    names = [node.name for node in model.graph.node]
    assert all(names) and len(set(names)) == len(names)
    loops = [node for node in model.graph.node if node.op_type == "Loop"]
    assert all("table" in names_read(node) and "table" not in node.input for node in loops)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    for pairs, pixels in ((2, 32), (3, 80)):  # another number of both
        arguments = drawn(pairs, pixels)
        feed = dict(zip(("queries", "table", "rows"), (argument.numpy() for argument in arguments), strict=True))
        np.testing.assert_allclose(session.run(None, feed)[0], Both(0)(*arguments), rtol=1e-4, atol=1e-4)


def test_few_numbers_are_gathered_at_once(tmp_path) -> None:
    arguments = torch.ones(1, 16, CHANNELS), torch.ones(16, CHANNELS), torch.zeros(1, 2, 16, dtype=torch.int32)
    model = exported(FEW - 1, arguments, str(tmp_path / "both.onnx"))
    assert not [node for node in model.graph.node if node.op_type == "Loop"]
