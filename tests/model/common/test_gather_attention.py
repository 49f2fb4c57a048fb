"""The gather attention of training and of exported graphs has the network's own values and gradients."""

import numpy as np
import onnx
import onnxruntime
import torch
from idesplat.export.graph.gather_loops import CANDIDATES_AT_A_TIME, FEW, chunked
from idesplat.export.graph.subgraph import names_read
from idesplat.model.common import gather_attention as gathered
from idesplat.model.common.gather_attention import GatherAttention
from idesplat.tools.benchmark.gather_attention import INPUTS, Both, exported
from idesplat.tools.training import gather_attention as training

PAIRS, CANDIDATES, PIXELS, CHANNELS = 4, 11, 30, 6
BLOCK = 8


def random_tensors() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Queries, weights, a table and rows, some of them its last row of zeros."""
    torch.manual_seed(0)
    rows = torch.randint(0, PAIRS * PIXELS + 1, (PAIRS, CANDIDATES, PIXELS), dtype=torch.int32)
    queries, weights = torch.randn(PAIRS, PIXELS, CHANNELS), torch.rand(PAIRS, CANDIDATES, PIXELS)
    return queries, weights, gathered.pixel_table(torch.randn(PAIRS, PIXELS, CHANNELS)), rows


def test_values_and_gradients_are_the_networks_own() -> None:
    queries, weights, table, rows = random_tensors()
    for name, left in (("gathered_dot", queries), ("gathered_weighted_sum", weights)):
        results = []
        for module in (gathered, training):
            inputs = [part.clone().requires_grad_() for part in (left, table)]
            product = getattr(module, name)(*inputs, rows)
            gradients = torch.autograd.grad(product.square().sum(), inputs)
            results.append((product, *gradients))
        for expected, found in zip(*results, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_sums_on_a_gpu_are_those_on_a_cpu() -> None:
    queries, weights, table, rows = random_tensors()
    torch.testing.assert_close(training.bag_dot(queries, table, rows), training.gathered_dot(queries, table, rows))
    expected = training.gathered_weighted_sum(weights, table, rows)
    torch.testing.assert_close(training.bag_weighted_sum(weights, table, rows), expected)


def test_exported_values_are_the_networks_own() -> None:
    rng = np.random.default_rng(0)

    def random_inputs(pairs: int, pixels: int) -> tuple[np.ndarray, ...]:
        rows = rng.integers(0, 2 * pixels, (pairs, CANDIDATES, pixels), np.int32)
        queries = rng.standard_normal((pairs, pixels, CHANNELS), np.float32)
        return queries, rng.standard_normal((2 * pixels, CHANNELS), np.float32), rows

    model = exported(BLOCK, random_inputs(2, 4 * BLOCK), in_chunks=True)
    onnx.checker.check_model(model, full_check=True)
    assert [node.op_type for node in model.graph.node].count("Loop") == 2
    assert {node.domain for node in model.graph.node} == {""}
    names = [node.name for node in model.graph.node]
    assert all(names) and len(set(names)) == len(names)
    loops = [node for node in model.graph.node if node.op_type == "Loop"]
    assert all("table" in names_read(node) and "table" not in node.input for node in loops)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    for pairs, blocks in ((2, 4), (3, 10)):  # another number of both
        arrays = random_inputs(pairs, blocks * BLOCK)
        expected = Both(BLOCK)(*(torch.from_numpy(array) for array in arrays))
        found = session.run(None, dict(zip(INPUTS, arrays, strict=True)))[0]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_the_networks_own_are_put_back() -> None:
    network = Both(BLOCK)
    with chunked(network):
        assert network.gather_attention.gathered_dot is not gathered.gathered_dot
    assert (
        network.gather_attention.gathered_dot is gathered.gathered_dot
        and network.gather_attention.gathered_weighted_sum is gathered.gathered_weighted_sum
    )


def test_few_numbers_are_gathered_a_few_candidates_of_all_pixels_at_a_time() -> None:
    attention = GatherAttention(FEW - 1, BLOCK)
    queries, weights, table, rows = random_tensors()
    with chunked(attention):
        for operation, own in (
            (attention.gathered_dot, gathered.gathered_dot),
            (attention.gathered_weighted_sum, gathered.gathered_weighted_sum),
        ):
            assert operation.func is own
            assert operation.keywords == {"chunk": CANDIDATES_AT_A_TIME}
        scores = attention.gathered_dot(queries, table, rows)
        sums = attention.gathered_weighted_sum(weights, table, rows)
    torch.testing.assert_close(scores, (table[rows.long()] * queries[:, None]).sum(-1))
    torch.testing.assert_close(sums, (table[rows.long()] * weights[..., None]).sum(1))
